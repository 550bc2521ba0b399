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
        height, width = self.size_hw
        window = Window(_pixels_between(y1, y2, height), _pixels_between(x1, x2, width))
        return window, self.at(row, np.arange(height)[window.rows], np.arange(width)[window.columns])

    def at(self, row: int, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Which pixels (r, c) in `rows` (r,) and `columns` (c,) of the image a detection's mask has.

        The mask is not cut off at the box, and beyond the image it goes on as at its edge.
        """
        (height, width), (cells_y, cells_x) = self.size_hw, self.prototypes.shape[1:]
        inside = np.zeros((len(rows), len(columns)), np.bool_)
        if inside.size:
            rows_of_cells, ys = _cells_at(rows, cells=cells_y, pixels=height)
            columns_of_cells, xs = _cells_at(columns, cells=cells_x, pixels=width)
            with np.errstate(all="ignore"):  # of very large numbers the share is 0, 1 or NaN
                part = self.prototypes[:, rows_of_cells, columns_of_cells]
                logits: NDArray[np.float32] = np.tensordot(self.coefficients[row], part, axes=1)
                shares = np.asarray(1 / (1 + np.exp(-logits)), np.float32)
                shares = np.ascontiguousarray(_interpolated(shares.T, xs).T)
                band = max(_BAND_PIXELS // len(xs), 1)
                for first in range(0, len(ys), band):
                    of_band = _interpolated(shares, ys[first : first + band])
                    np.greater(of_band, 0.5, out=inside[first : first + band])
        return inside

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


def _pixels_between(low: float, high: float, pixels: int) -> slice:
    """Those of the first `pixels` from `low` to below `high`."""
    return slice(*(min(max(math.ceil(bound), 0), pixels) for bound in (low, max(low, high))))


def _cells_at(indices: NDArray[np.intp], *, cells: int, pixels: int) -> tuple[slice, NDArray[np.float64]]:
    """The cells around pixels with the `indices` (n,), and where (n,) among these each pixel is.

    Of an axis with `cells`, which are resized to `pixels`. The centres of the first and the last cell are
    half a cell from the edges of the image, as in OpenCV's INTER_LINEAR. Pixels beyond these centres have the
    value of that cell.
    """
    places = np.clip((indices + 0.5) * (cells / pixels) - 0.5, 0, cells - 1)
    origin = int(places.min())
    return slice(origin, int(places.max()) + 2), places - origin


def _interpolated(values: NDArray[np.float32], places: NDArray[np.float64]) -> NDArray[np.float32]:
    """The rows (n, m) at `places` (n,) between those of `values` (k, m)."""
    before = places.astype(np.intp)
    found = values.take(before, axis=0)
    rise = values.take(np.minimum(before + 1, len(values) - 1), axis=0)
    rise -= found
    rise *= (places - before).astype(np.float32)[:, None]
    found += rise
    return found
