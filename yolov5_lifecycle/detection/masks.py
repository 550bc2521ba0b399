"""Masks of detections: which pixels of the image belong to each object."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

MAX_LABEL = int(np.iinfo(np.uint16).max)
MAX_MASK_PIXELS = 1 << 29
"""Max number of pixels in the boxes whose masks are computed for one label image: a few seconds."""
_BAND_PIXELS = 1 << 16
"""Pixels computed at once, which fit into the cache of a processor."""


@dataclass(frozen=True, eq=False)
class Masks:
    """Masks of the detections of one image; each is computed on request.

    As in YOLOv5 for masks of the size of the source image (`process_mask_native`): a combination of
    prototypes, put through the logistic function, resized to the image, cut off at the box, above 0.5.
    """

    prototypes: NDArray[np.float32]
    """(M, h, w) for the whole image."""
    coefficients: NDArray[np.float32]
    """(n, M), a row for each detection."""
    size_hw: tuple[int, int]
    """Size of the image in pixels."""

    @classmethod
    def in_image(
        cls, prototypes: NDArray[np.float32], coefficients: NDArray[np.float32], size_hw: tuple[int, int]
    ) -> Masks:
        """Masks in an image of `size_hw` from `prototypes` (M, h, w) for the network input, with its padding.

        The padding is cut off as YOLOv5 does it, rounded to whole cells.
        """
        cells_hw = prototypes.shape[1:]
        scale = min(cells / pixels for cells, pixels in zip(cells_hw, size_hw, strict=True))
        paddings = [(cells - pixels * scale) / 2 for cells, pixels in zip(cells_hw, size_hw, strict=True)]
        rows, columns = (
            slice(int(padding), int(cells - padding))
            for cells, padding in zip(cells_hw, paddings, strict=True)
        )
        return cls(prototypes[:, rows, columns], coefficients, size_hw)

    def __len__(self) -> int:
        return len(self.coefficients)

    def of(self, rows: NDArray[np.int64]) -> Masks:
        """The masks of the detections with the indices `rows` (n,)."""
        return Masks(self.prototypes, self.coefficients[rows], self.size_hw)

    def inside_box(self, row: int, box_xyxy: NDArray[np.float32]) -> tuple[Window, NDArray[np.bool_]]:
        """Where in the image the box of a detection is, and which pixels there belong to the object.

        `box_xyxy` (4,) in pixels of the image. A pixel is in the box if its indices are. The cost is that of
        the pixels in the box, whatever the size of the image.
        """
        x1, y1, x2, y2 = box_xyxy.tolist()
        (height, width), (cells_y, cells_x) = self.size_hw, self.prototypes.shape[1:]
        ys, xs = _Axis.of(y1, y2, cells=cells_y, pixels=height), _Axis.of(x1, x2, cells=cells_x, pixels=width)
        inside = np.zeros((len(ys.before), len(xs.before)), np.bool_)
        if inside.size:
            with np.errstate(all="ignore"):  # of very large numbers the share is 0, 1 or NaN
                part = self.prototypes[:, ys.cells, xs.cells]
                logits: NDArray[np.float32] = np.tensordot(self.coefficients[row], part, axes=1)
                share = np.asarray(1 / (1 + np.exp(-logits)), np.float32)
                _interpolate(share, ys, xs, inside)
        return Window(ys.pixels, xs.pixels), inside

    def label_image(self, boxes_xyxy: NDArray[np.float32]) -> NDArray[np.uint16]:
        """An image (H, W) with 0 for the background and i + 1 for the pixels of the i-th detection.

        Where masks overlap, that of the higher score is visible. Detections after the first MAX_LABEL, and
        those after the first whose boxes together have more than MAX_MASK_PIXELS, have no pixels.
        `boxes_xyxy` (n, 4) in pixels of the image.
        """
        labels = np.zeros(self.size_hw, np.uint16)
        sides = np.diff(np.clip(boxes_xyxy.reshape(-1, 2, 2), 0, self.size_hw[::-1]), axis=1)
        affordable = int(
            np.count_nonzero(np.cumsum(np.prod(sides, axis=(1, 2), dtype=np.float64)) <= MAX_MASK_PIXELS)
        )
        for row in reversed(range(min(affordable, MAX_LABEL))):
            window, mask = self.inside_box(row, boxes_xyxy[row])
            labels[window.rows, window.columns][mask] = row + 1
        return labels


class Window(NamedTuple):
    """A part of an image."""

    rows: slice
    columns: slice


class _Axis(NamedTuple):
    """Pixels of one axis of the image, and the cells between which their values are interpolated.

    The centres of the first and the last cell are half a cell from the edges of the image, as in OpenCV's
    INTER_LINEAR. Pixels beyond these centres have the value of that cell.
    """

    pixels: slice
    cells: slice
    before: NDArray[np.intp]
    """(n,): the cell before each pixel's centre, counted from the first of `cells`."""
    after: NDArray[np.intp]
    weights: NDArray[np.float32]
    """(n,): the share of the cell after it, from 0 to 1."""

    @classmethod
    def of(cls, low: float, high: float, *, cells: int, pixels: int) -> _Axis:
        """The axis for pixel indices from `low` to below `high`, where `cells` are resized to `pixels`."""
        first, end = (min(max(math.ceil(bound), 0), pixels) for bound in (low, max(low, high)))
        places = np.clip((np.arange(first, end) + 0.5) * (cells / pixels) - 0.5, 0, cells - 1)
        before = places.astype(np.intp)
        origin, last = (before[0], before[-1]) if len(before) else (0, -1)
        part = slice(int(origin), min(int(last) + 2, cells))
        after = np.minimum(before + 1, cells - 1)
        return cls(
            slice(first, end), part, before - origin, after - origin, (places - before).astype(np.float32)
        )


def _interpolate(share: NDArray[np.float32], ys: _Axis, xs: _Axis, inside: NDArray[np.bool_]) -> None:
    """Write into `inside` (n, m) which pixels have a share above 0.5, from the share of each cell."""
    columns = share.take(xs.before, axis=1)
    columns += (share.take(xs.after, axis=1) - columns) * xs.weights
    band = max(_BAND_PIXELS // inside.shape[1], 1)
    for first in range(0, len(inside), band):
        rows = slice(first, first + band)
        values = columns.take(ys.before[rows], axis=0)
        rise = columns.take(ys.after[rows], axis=0)
        rise -= values
        rise *= ys.weights[rows, None]
        values += rise
        np.greater(values, 0.5, out=inside[rows])
