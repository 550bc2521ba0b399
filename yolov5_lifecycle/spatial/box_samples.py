"""Samples of a depth image in and around boxes, on a grid, so that the cost does not depend on their size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

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
_CELLS = (np.arange(SIDE, dtype=np.float32) + 0.5) / SIDE

RING = len(_RING)
"""Samples between a box and the outermost ones around it."""
GRID = SIDE + 2 * RING
"""Samples along each side of the grid: those of the box, and those around it."""
IS_AROUND = np.ones((GRID, GRID), np.bool_)
IS_AROUND[RING:-RING, RING:-RING] = False


@dataclass(frozen=True, eq=False)
class BoxSamples:
    """Depth in metres in and around n boxes, and where it was measured."""

    metres: NDArray[np.float32]
    """(n, GRID, GRID), NaN where there is no measurement; IS_AROUND tells which lie around the box."""
    columns: NDArray[np.intp]
    """(n, GRID) in pixels of the depth image, rising."""
    rows: NDArray[np.intp]
    """(n, GRID)."""


def sampled(depth: DepthImage, boxes_xyxy: NDArray[np.float32]) -> BoxSamples:
    """Samples for the boxes (n, 4), finite corners in pixels of the depth image."""
    columns, rows = _positions(boxes_xyxy[:, 0::2]), _positions(boxes_xyxy[:, 1::2])
    return BoxSamples(depth.metres_at(rows[:, :, None], columns[:, None, :]), columns, rows)


Values = TypeVar("Values", bound=np.generic)


def inside(values: NDArray[Values]) -> NDArray[Values]:
    """Those of the values (n, GRID, GRID) that lie in the box, (n, SIDE, SIDE)."""
    return values[:, RING:-RING, RING:-RING]


def around(values: NDArray[Values]) -> NDArray[Values]:
    """Those of the values (n, GRID, GRID) that lie around the box, (n, r), row by row."""
    return values[:, IS_AROUND]


def _positions(ends: NDArray[np.float32]) -> NDArray[np.intp]:
    """Pixel indices (n, GRID) along one axis, for the ends (n, 2) of a box on that axis."""
    start, end = np.hsplit(ends.clip(-_FAR_PX, _FAR_PX), 2)
    side = end - start
    margin = np.maximum(_RING * side, _MIN_RING_PX)
    places = np.concatenate((start - margin[:, ::-1], start + _CELLS * side, end + margin), axis=1)
    return np.asarray(np.floor(places), np.intp)
