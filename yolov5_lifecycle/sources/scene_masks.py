"""Which pixels of a scene belong to which shape."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray


def label_image(outlines: Sequence[NDArray[np.float64]], size_hw: tuple[int, int]) -> NDArray[np.uint16]:
    """An image (H, W) with 0 for the background and i + 1 for the pixels of the i-th shape.

    `outlines`: the corners (k, 2) of each shape in pixels, as `Shape.outline` gives them. A pixel belongs to
    a shape if its centre is inside the outline, and of several to the last, which is drawn over the others.
    """
    labels = np.zeros(size_hw, np.uint16)
    for label, outline in enumerate(outlines, start=1):
        low = np.clip(np.floor(outline.min(axis=0)).astype(int), 0, size_hw[::-1])
        high = np.clip(np.ceil(outline.max(axis=0)).astype(int), 0, size_hw[::-1])
        part = labels[low[1] : high[1], low[0] : high[0]]
        part[_inside(outline - low, part.shape)] = label
    return labels


def _inside(outline: NDArray[np.float64], size_hw: tuple[int, ...]) -> NDArray[np.bool_]:
    """The pixels (h, w) whose centres have an odd number of crossings with `outline` on their left."""
    height, width = size_hw
    centres_y = np.arange(height)[:, None] + 0.5
    (from_x, from_y), (to_x, to_y) = outline.T, np.roll(outline, -1, axis=0).T
    rows, edges = ((from_y <= centres_y) != (to_y <= centres_y)).nonzero()
    shares = (centres_y[rows, 0] - from_y[edges]) / (to_y[edges] - from_y[edges])
    crossings_x = from_x[edges] + shares * (to_x[edges] - from_x[edges])
    first_right = np.clip(np.ceil(crossings_x - 0.5), 0, width).astype(int)
    crossings = np.zeros((height, width + 1), np.uint8)
    np.add.at(crossings, (rows, first_right), 1)
    return np.asarray(np.cumsum(crossings, axis=1, dtype=np.uint8)[:, :width] % 2, np.bool_)
