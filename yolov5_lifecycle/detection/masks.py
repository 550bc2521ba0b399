"""Masks of detections: which pixels of the image belong to each object."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_LABEL = int(np.iinfo(np.uint16).max)


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

        `box_xyxy` (4,) in pixels of the image. A pixel is in the box if its indices are.
        """
        x1, y1, x2, y2 = box_xyxy.tolist()
        (height, width), (cells_y, cells_x) = self.size_hw, self.prototypes.shape[1:]
        ys, xs = _Span.of(y1, y2, cells=cells_y, pixels=height), _Span.of(x1, x2, cells=cells_x, pixels=width)
        window = Window(ys.wanted, xs.wanted)
        if not (ys.size and xs.size):
            return window, np.zeros((ys.size, xs.size), np.bool_)
        part = self.prototypes[:, ys.cells, xs.cells]
        with np.errstate(all="ignore"):  # of very large numbers the share is 0, 1 or NaN
            share = 1 / (1 + np.exp(-np.tensordot(self.coefficients[row], part, axes=1)))
        share = cv2.resize(share, (xs.resized, ys.resized), interpolation=cv2.INTER_LINEAR)
        return window, share[ys.inside, xs.inside] > 0.5

    def label_image(self, boxes_xyxy: NDArray[np.float32]) -> NDArray[np.uint16]:
        """An image (H, W) with 0 for the background and i + 1 for the pixels of the i-th detection.

        Where masks overlap, that of the higher score is visible. Detections after the first MAX_LABEL have
        no pixels. `boxes_xyxy` (n, 4) in pixels of the image.
        """
        labels = np.zeros(self.size_hw, np.uint16)
        for row in reversed(range(min(len(self), MAX_LABEL))):
            window, mask = self.inside_box(row, boxes_xyxy[row])
            labels[window.rows, window.columns][mask] = row + 1
        return labels


class Window(NamedTuple):
    """A part of an image."""

    rows: slice
    columns: slice


class _Span(NamedTuple):
    """One axis of an image part that is resized alone, with the same result as in the whole image.

    This requires cells that begin where a pixel begins, and at least one more on each side than `wanted`.
    """

    cells: slice
    resized: int
    inside: slice
    wanted: slice

    @classmethod
    def of(cls, low: float, high: float, *, cells: int, pixels: int) -> _Span:
        """The axis for pixel indices from `low` to below `high`, where `cells` are resized to `pixels`."""
        first, end = (min(max(math.ceil(bound), 0), pixels) for bound in (low, max(low, high)))
        blocks = math.gcd(cells, pixels)
        block_cells, block_pixels = cells // blocks, pixels // blocks
        first_block = max(first // block_pixels - 1, 0)
        end_block = min(-(-end // block_pixels) + 1, blocks)
        origin = first_block * block_pixels
        return cls(
            cells=slice(first_block * block_cells, end_block * block_cells),
            resized=end_block * block_pixels - origin,
            inside=slice(first - origin, end - origin),
            wanted=slice(first, end),
        )

    @property
    def size(self) -> int:
        """Number of pixels wanted."""
        return int(self.wanted.stop - self.wanted.start)
