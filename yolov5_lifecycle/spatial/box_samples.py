"""Depth sampled on a grid in and around each box; the cost does not depend on the size of the box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.depth_image import DepthImage

SIDE = 20
"""Samples along each side of a box."""

_RING = np.array((0.12, 0.19, 0.26), np.float32)
"""Distances from the box, in parts of its side: far enough for a box that is a little too small."""
_MIN_RING_PX = np.array((2, 3, 4), np.float32)
_FAR_PX = 1e6
"""Far outside every image, and still an integer after a margin is added."""
_INSIDE = (np.arange(SIDE, dtype=np.float32) + 0.5) / SIDE


@dataclass(frozen=True, eq=False)
class BoxSamples:
    """Depth in metres in and around n boxes; NaN where there is no measurement."""

    inside: NDArray[np.float32]
    """(n, SIDE * SIDE) evenly spread over the box."""
    around: NDArray[np.float32]
    """(n, r) on a ring around the box, with a gap between."""


def sampled(depth: DepthImage, boxes_xyxy: NDArray[np.float32]) -> BoxSamples:
    """Samples for the boxes (n, 4), finite corners in pixels of the depth image."""
    count, ring = len(boxes_xyxy), len(_RING)
    columns, rows = _positions(boxes_xyxy[:, 0::2]), _positions(boxes_xyxy[:, 1::2])
    grid = depth.metres_at(rows[:, :, None], columns[:, None, :])  # (n, SIDE + 2 * ring, the same)
    is_inside = np.zeros(grid.shape[1:], np.bool_)
    is_inside[ring:-ring, ring:-ring] = True
    return BoxSamples(inside=grid[:, ring:-ring, ring:-ring].reshape(count, -1), around=grid[:, ~is_inside])


def _positions(ends: NDArray[np.float32]) -> NDArray[np.intp]:
    """Pixel indices (n, SIDE + 2 * ring) along one axis, for the ends (n, 2) of a box on that axis."""
    start, end = np.hsplit(ends.clip(-_FAR_PX, _FAR_PX), 2)
    side = end - start
    margin = np.maximum(_RING * side, _MIN_RING_PX)
    places = np.concatenate((start - margin[:, ::-1], start + _INSIDE * side, end + margin), axis=1)
    return np.asarray(np.floor(places), np.intp)
