"""Masks as YOLOv5's `process_mask_native` computes them, one pixel of the whole image at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.masks import Masks


def reference_mask(masks: Masks, row: int, box_xyxy: NDArray[np.float32]) -> NDArray[np.float64]:
    """The share (H, W) of detection `row` in every pixel, 0 outside the box; above 0.5 it has the pixel."""
    logits = np.einsum("m,mhw->hw", masks.coefficients[row].astype(np.float64), masks.prototypes)
    share = 1 / (1 + np.exp(-logits))
    (height, width), (cells_y, cells_x) = masks.size_hw, share.shape
    y, below, weight_y = _neighbours(height, cells_y)
    x, right, weight_x = _neighbours(width, cells_x)
    left_right = share[:, x] * (1 - weight_x) + share[:, right] * weight_x
    resized = left_right[y] * (1 - weight_y)[:, None] + left_right[below] * weight_y[:, None]
    x1, y1, x2, y2 = box_xyxy
    rows, columns = np.arange(height)[:, None], np.arange(width)
    return np.where((rows >= y1) & (rows < y2) & (columns >= x1) & (columns < x2), resized, 0)


def whole_mask(masks: Masks, row: int, box_xyxy: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The mask of detection `row` in the whole image (H, W)."""
    window, inside = masks.inside_box(row, box_xyxy)
    mask = np.zeros(masks.size_hw, np.bool_)
    mask[window.rows, window.columns] = inside
    return mask


def _neighbours(pixels: int, cells: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """The cells before and after each pixel's centre, and how near the latter is."""
    places = np.maximum((np.arange(pixels) + 0.5) * cells / pixels - 0.5, 0)
    before = np.floor(places).astype(np.intp)
    return np.minimum(before, cells - 1), np.minimum(before + 1, cells - 1), places - before
