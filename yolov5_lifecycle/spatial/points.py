"""Points of objects' own surfaces: pixels that continue what the samples of a box show of the object."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.box_samples import SIDE
from yolov5_lifecycle.spatial.camera_model import Intrinsics
from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.surface import Surfaces

MAX_PIXELS = 1 << 21
"""Looked at in the boxes of an image. Of larger boxes only every second row and column, every third, ..."""
_CONTINUES = 0.03
"""Of the depth: a pixel that differs by less from a sample next to it is on the same surface."""

Array = NDArray[np.float32]
Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """p points on the surface of an object."""

    box: int
    """Index of the object's box."""
    xyz_m: Array
    """(p, 3) in metres from the camera: x right, y down, z forward."""
    rows: Indices
    """(p,) of the pixels that show them."""
    columns: Indices
    """(p,)."""


def surface_points(
    surfaces: Surfaces, depth: DepthImage, camera: Intrinsics, *, spacing_m: float = 0.0
) -> Iterator[SurfacePoints]:
    """Points on the visible surface of each object that was found in the camera's depth image.

    They are `spacing_m` apart where the object is nearest and faces the camera, but not more than the samples
    of its box and not less than pixels are.
    """
    sides = np.diff(np.clip(surfaces.boxes_xyxy.reshape(-1, 2, 2), 0, depth.size_hw[::-1]), axis=1)
    step_px = max(math.ceil(math.sqrt(sides.prod(axis=(1, 2), dtype=np.float64).sum() / MAX_PIXELS)), 1)
    low_m, high_m = (_extreme(surfaces.metres, of) for of in (np.fmin, np.fmax))
    nearest_m = np.fmin.reduce(low_m, axis=(1, 2))
    for index in np.flatnonzero(np.isfinite(nearest_m)):
        samples = low_m[index], high_m[index], surfaces.beside_m[index]
        spacing_px = int(spacing_m * camera.fx / nearest_m[index])
        box_xyxy = surfaces.boxes_xyxy[index]
        yield SurfacePoints(int(index), *_points(box_xyxy, samples, depth, camera, step_px, spacing_px))


def _extreme(metres: Array, of: np.ufunc) -> Array:
    """The least or greatest depth of each sample (n, SIDE, SIDE) and the eight next to it; NaN: not seen."""
    for _ in range(2):
        padded = np.pad(metres, ((0, 0), (1, 1), (0, 0)), constant_values=np.nan)
        metres = of(of(padded[:, :-2], padded[:, 1:-1]), padded[:, 2:]).transpose(0, 2, 1)
    return metres


def _points(
    box_xyxy: Array,
    samples: tuple[Array, Array, Array],
    depth: DepthImage,
    camera: Intrinsics,
    step_px: int,
    spacing_px: int,
) -> tuple[Array, Indices, Indices]:
    """Points (p, 3) of the pixels in a box that are on the object's surface, and their rows and columns (p,).

    `samples` (SIDE, SIDE) each: the least and the greatest depth of the surface, and that of what else is
    there. Every `step_px`-th row and column is looked at.
    """
    x1, y1, x2, y2 = box_xyxy.tolist()
    height, width = depth.size_hw
    rows, columns = _between(y1, y2, height, step_px), _between(x1, x2, width, step_px)
    metres = depth.metres_in(rows, columns)
    cells = _cells(rows, y1, y2), _cells(columns, x1, x2)
    low_m, high_m, beside_m = (values[cells[0]][:, cells[1]] for values in samples)
    is_seen = (metres >= (1 - _CONTINUES) * low_m) & (metres <= (1 + _CONTINUES) * high_m)
    is_seen &= ~((metres >= (1 - _CONTINUES) * beside_m) & (metres <= (1 + _CONTINUES) * beside_m))
    seen = np.flatnonzero(is_seen)
    down, across = np.divmod(seen, len(columns)) if len(seen) else (seen, seen)
    # Not farther apart than the samples, or small objects would vanish between the points.
    block_hw = [max(min(spacing_px, len(each) * step_px // SIDE) // step_px, 1) for each in (rows, columns)]
    if max(block_hw) > 1:
        kept = _one_a_block(down // block_hw[0], across // block_hw[1])
        seen, down, across = seen[kept], down[kept], across[kept]
    row, column = np.asarray(rows, np.intp)[down], np.asarray(columns, np.intp)[across]
    return _in_space(row, column, metres.ravel()[seen], camera)


def _in_space(
    rows: Indices, columns: Indices, metres: Array, camera: Intrinsics
) -> tuple[Array, Indices, Indices]:
    """The points (p, 3) that pixels (n,) show, and the rows and columns (p,) of those that have a ray."""
    x, y = camera.tangents(columns + np.float64(0.5), rows + np.float64(0.5))
    xyz_m = np.empty((len(metres), 3), np.float32)
    xyz_m[:, 0], xyz_m[:, 1], xyz_m[:, 2] = x * metres, y * metres, metres
    if camera.distortion is None:
        return xyz_m, rows, columns
    has_ray = np.isfinite(x)
    return xyz_m[has_ray], rows[has_ray], columns[has_ray]


def _one_a_block(down: Indices, across: Indices) -> Indices:
    """The first of the pixels (n,) in each block, whose places are counted from the box's corner."""
    if not len(down):
        return down
    blocks = down * (across.max() + 1) + across
    first = np.full(blocks.max() + 1, -1)
    first[blocks[::-1]] = np.arange(len(blocks))[::-1]
    return first[first >= 0]


def _between(start: float, end: float, pixels: int, step_px: int) -> range:
    """Every `step_px`-th of the first `pixels` whose centre lies between two sides of a box."""
    first, last = (min(max(math.ceil(side - 0.5), 0), pixels) for side in (start, end))
    return range(first, last, step_px)


def _cells(places: range, start: float, end: float) -> Indices:
    """The sample of a box that is nearest to each of the pixels."""
    cells = (np.asarray(places) + 0.5 - start) / (end - start) * SIDE
    return cells.astype(np.intp).clip(0, SIDE - 1)
