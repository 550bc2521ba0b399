"""Sparse detection head on the CPU, computed only for grid cells that may contain an object."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from yolov5_lifecycle.models.head import Detect

Features = NDArray[np.float32]
"""Feature map of one detection level, (batch, channels, ny, nx)."""


class DetectionHead:
    """`Detect` and `Segment` in numpy: of 15,120 predictions per image, at most about 300 are evaluated.

    Evaluating all would be a twelfth of the network's arithmetic and 5 MB to convert and pass on: together a
    fifth of the time of yolov5n at 384x640.
    """

    def __init__(self, detect: Detect) -> None:
        self._levels = [
            _Level(convolution, anchors, stride, detect)
            for convolution, anchors, stride in zip(detect.m, detect.anchors, detect.strides, strict=True)
        ]

    def __call__(self, features: Sequence[Features], min_objectness: float) -> NDArray[np.float32]:
        """The rows specified by `Runtime`, all anchors of a cell at once, from the features of one image."""
        with np.errstate(all="ignore"):  # NaN propagates to the caller, which checks the rows
            min_logit = np.log(min_objectness) - np.log1p(-min_objectness)
            rows = [
                level.rows(known, np.flatnonzero(~(level.objectness(known) < min_logit)))
                for level, known in zip(self._levels, features, strict=True)
            ]
        return np.concatenate(rows)


class _Level:
    """The 1x1 convolution of one level and the decoding of its output."""

    def __init__(self, convolution: nn.Module, anchors: Tensor, stride: int, detect: Detect) -> None:
        assert isinstance(convolution, nn.Conv2d)
        assert convolution.bias is not None
        shape = (len(anchors), detect.outputs, -1)
        self._weights = convolution.weight.numpy().reshape(shape)  # (anchors, outputs, channels)
        self._bias = convolution.bias.numpy().reshape(shape)  # (anchors, outputs, 1)
        self._anchors_px = anchors.numpy()[:, None] * np.float32(stride)  # (anchors, 1, 2)
        self._stride = stride
        self._bounded = detect.outputs - detect.coefficients

    def objectness(self, features: Features) -> NDArray[np.float32]:
        """The highest objectness logit of every cell, (ny * nx)."""
        logits = self._weights[:, 4] @ features.reshape(features.shape[1], -1) + self._bias[:, 4]
        highest: NDArray[np.float32] = logits.max(axis=0)
        return highest

    def rows(self, features: Features, cells: NDArray[np.intp]) -> NDArray[np.float32]:
        """Predictions (anchors * n, outputs) of n cells; formula: see `Detect.decode`."""
        _, channels, _, nx = features.shape
        logits = self._weights @ features.reshape(channels, -1)[:, cells] + self._bias
        rows = np.ascontiguousarray(logits.transpose(0, 2, 1))  # (anchors, n, outputs)
        sigma = rows[..., : self._bounded]  # all but the coefficients of masks
        sigma[:] = 1 / (1 + np.exp(-sigma))
        cells_xy = np.stack((cells % nx, cells // nx), axis=-1).astype(np.float32)
        sigma[..., :2] = (2 * sigma[..., :2] - 0.5 + cells_xy) * self._stride
        sigma[..., 2:4] = (2 * sigma[..., 2:4]) ** 2 * self._anchors_px
        predictions: NDArray[np.float32] = rows.reshape(-1, rows.shape[2])
        return predictions
