"""Samples of a depth image in and around boxes, and which of them are background.

They lie on a grid, so that the cost does not depend on the size of a box. Background is what goes on around a
box: planes, as the floor and walls, and whatever else is connected, as a crate before the object. Along a
plane in space, 1 / depth changes linearly with x / z and y / z of the rays, so that the height of the camera
need not be known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.camera_model import Intrinsics
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
    x: NDArray[np.float32]
    """x / z of the samples' rays, less the middle's, in parts of the grid; 0 where the lens sees nothing.

    (n, GRID, GRID), or what is broadcast to that.
    """
    y: NDArray[np.float32]
    """The same of y / z, so that all coefficients of a plane are alike in size."""


def sampled(depth: DepthImage, boxes_xyxy: NDArray[np.float32], camera: Intrinsics) -> BoxSamples:
    """Samples for the boxes (n, 4), finite corners in pixels of the depth image."""
    columns, rows = _positions(boxes_xyxy[:, 0::2]), _positions(boxes_xyxy[:, 1::2])
    across, down = columns[:, None, :], rows[:, :, None]
    metres = depth.metres_at(down, across)
    x, y = camera.tangents(across + np.float64(0.5), down + np.float64(0.5))
    if camera.distortion:
        metres[np.isnan(x)] = np.nan
        x, y = np.nan_to_num(x), np.nan_to_num(y)
    return BoxSamples(metres, columns, rows, _parts(x, columns, camera.fx), _parts(y, rows, camera.fy))


def _parts(tangents: NDArray[np.float64], places: NDArray[np.intp], focal_px: float) -> NDArray[np.float32]:
    scale = focal_px / np.maximum(places[:, -1] - places[:, 0], 1)
    middle = tangents[:, tangents.shape[1] // 2, tangents.shape[2] // 2]
    parts: NDArray[np.float32] = ((tangents - middle[:, None, None]) * scale[:, None, None]).astype(
        np.float32
    )
    return parts


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


_PLANES = 2
"""Planes removed from each box: mostly the floor and a wall."""
_TRIALS = 64
"""Planes through three samples of which the best are chosen."""
_TRIAL_TOLERANCE = 0.02
"""Share of the depth within which a trial explains a sample."""
_NOISE = 3.0
"""Standard deviations from a plane within which a sample is part of it."""
_MIN_TOLERANCE, _MAX_TOLERANCE = 0.012, 0.05
"""The least and the most that this may be, as a share of the depth."""
_MIN_SHARE = 0.2
"""Share of the samples around a box that a plane must explain."""
_MIN_SIDE_SHARE = 0.15
"""The same left or right, and above or below: an object beside this one, and as far away, is no plane."""
_MIN_MEASURED = 0.25
"""Share of samples that counts as measured, even if fewer are, as at the edge of the image."""

Array = NDArray[np.float32]


def _turning_order() -> NDArray[np.intp]:
    """Every third sample around a box, in the order of their angles."""
    places = np.flatnonzero(IS_AROUND)
    rows, columns = np.divmod(places, GRID)
    middle = (GRID - 1) / 2
    return places[np.argsort(np.arctan2(rows - middle, columns - middle), kind="stable")][::3]


def _groups(places: NDArray[np.intp]) -> Array:
    """(5, r): 1 where a sample is left, right, above or below the box, and not at a corner; and 1 for all."""
    rows, columns = np.divmod(places, GRID)
    last = GRID - RING
    is_level = (rows >= RING) & (rows < last)
    is_upright = (columns >= RING) & (columns < last)
    sides = (
        (columns < RING) & is_level,
        (columns >= last) & is_level,
        (rows < RING) & is_upright,
        (rows >= last) & is_upright,
    )
    return np.stack((*sides, np.ones_like(is_level))).astype(np.float32)


def _triples() -> Array:
    """(trials, 3) places on the way around a box, in [0, 1): three of one arc, because a plane fills arcs."""
    trial = np.arange(_TRIALS)
    start, share = trial * 0.618, 0.35 + 0.3 * (trial * 0.755 % 1)
    arc = np.take((0.35, 0.5, 0.75), trial % 3)
    return (np.stack((start, start + share * arc, start + arc), axis=1) % 1).astype(np.float32)


_PLACES = _turning_order()
_GROUPS = _groups(_PLACES)
_LEAST = _MIN_MEASURED * _GROUPS.sum(axis=1)
_TRIPLES = _triples()


def is_on_plane_beyond(samples: BoxSamples) -> NDArray[np.bool_]:
    """Which of the samples (n, GRID, GRID) are on planes that go on around the box."""
    count = len(samples.metres)
    terms = _terms(samples)
    around = np.ascontiguousarray(terms[:, :, _PLACES])
    is_free = around[:, 2] > 0
    measured = is_free.astype(np.float32) @ _GROUPS.T
    errors = around.transpose(0, 2, 1) @ _trials(around)  # (n, r, trials)
    errors -= 1
    near = np.less(np.abs(errors, out=errors), _TRIAL_TOLERANCE, out=errors)
    is_on_any = np.zeros((count, GRID * GRID), np.bool_)
    for _ in range(_PLANES):
        best, is_plane = _best(near, is_free, measured)
        if not is_plane.any():
            break
        plane, noise = _refined(around, is_free, near[np.arange(count), :, best] > 0)
        plane *= is_plane[:, None]
        is_on_any |= _is_on(plane, noise, terms)
        is_free &= ~_is_on(plane, noise, around)
    return is_on_any.reshape(samples.metres.shape)


def _terms(samples: BoxSamples) -> Array:
    """x / z, y / z and 1 of the samples (n, 3, GRID * GRID), each times the sample's depth; 0 without one.

    A sample is on a plane if these three, each times a coefficient of the plane, add up to 1.
    """
    metres = np.where(np.isnan(samples.metres), np.float32(0), samples.metres)
    terms = np.empty((len(metres), 3, GRID, GRID), np.float32)
    terms[:, 0] = metres * samples.x
    terms[:, 1] = metres * samples.y
    terms[:, 2] = metres
    return terms.reshape(len(terms), 3, -1)


def _best(
    near: Array, is_free: NDArray[np.bool_], measured: Array
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """The trial (n,) that explains most of the free samples (n, r), and whether that is a plane (n,).

    `near` (n, r, trials) is 1 for samples that a trial explains, `measured` (n, 5) tells how many samples of
    each group are measurements.
    """
    weights = _GROUPS * is_free[:, None, :] / np.maximum(measured, _LEAST)[..., None]
    shares = weights @ near  # (n, 5, trials)
    # Where nothing is measured, as outside the image, a plane may go on.
    left, right, above, below = (shares[:, :4] + (measured < _LEAST)[:, :4, None]).transpose(1, 0, 2)
    side_share = np.minimum(np.maximum(left, right), np.maximum(above, below))
    scores = shares[:, 4] * (side_share >= _MIN_SIDE_SHARE)
    return scores.argmax(axis=1), scores.max(axis=1) >= _MIN_SHARE


def _trials(around: Array) -> Array:
    """Planes (n, 3, trials) through three measurements each; 0 where three lie on a line."""
    is_free = around[:, 2] > 0
    order = np.argsort(~is_free, axis=1, kind="stable")  # the free ones first, on the way around the box
    picked = (_TRIPLES.ravel() * is_free.sum(axis=1, keepdims=True)).astype(np.intp)
    boxes = np.arange(len(around))[:, None]
    points = around.transpose(1, 0, 2)[:, boxes, order[boxes, picked]].reshape(3, len(around), -1, 3)
    one, two, three = points.transpose(3, 0, 1, 2)  # (3, n, trials) each
    across = _cross(two, three)
    volume = one[0] * across[0] + one[1] * across[1] + one[2] * across[2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        planes = (across + _cross(three, one) + _cross(one, two)) / volume
    planes[~np.isfinite(planes)] = 0
    return np.ascontiguousarray(planes.transpose(1, 0, 2))


def _cross(one: Array, other: Array) -> Array:
    """Cross products of vectors (3, ...); numpy's is many times slower for few vectors."""
    return np.stack(
        (
            one[1] * other[2] - one[2] * other[1],
            one[2] * other[0] - one[0] * other[2],
            one[0] * other[1] - one[1] * other[0],
        )
    )


def _refined(around: Array, is_free: NDArray[np.bool_], is_near: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The planes (n, 3) of the free samples that are near a trial or its regression, and their noise (n,)."""
    plane, noise = _regression(around, is_near & is_free)
    return _regression(around, _is_on(plane, noise, around) & is_free)


def _regression(around: Array, is_chosen: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The planes (n, 3) nearest to the chosen samples (n, r); their standard deviation (n,) of 1 / depth."""
    chosen = around * is_chosen[:, None, :]
    squares = (chosen @ around.transpose(0, 2, 1)).astype(np.float64)
    ridge = 1e-9 * squares[:, 2, 2] + 1e-12  # three samples on a line, or none, have no plane
    squares[:, (0, 1, 2), (0, 1, 2)] += ridge[:, None]
    sums = chosen.sum(axis=2, dtype=np.float64)
    plane = np.linalg.solve(squares, sums[..., None])[..., 0].astype(np.float32)
    errors = (plane[:, None, :] @ around)[:, 0] - 1
    errors *= is_chosen / np.maximum(around[:, 2], np.float32(1e-6))
    return plane, np.sqrt((errors * errors).sum(axis=1) / np.maximum(is_chosen.sum(axis=1), 1))


def _is_on(plane: Array, noise: Array, terms: Array) -> NDArray[np.bool_]:
    """Whether samples (n, r) are on the planes (n, 3) whose 1 / depth has the standard deviation `noise`."""
    errors = (plane[:, None, :] @ terms)[:, 0]
    errors -= 1
    tolerance = terms[:, 2] * (_NOISE * noise)[:, None].astype(np.float32)
    np.clip(tolerance, _MIN_TOLERANCE, _MAX_TOLERANCE, out=tolerance)
    return np.asarray(np.abs(errors, out=errors) < tolerance)


_MAX_SLOPE = 0.15
"""Of the depth's logarithm, from a sample in a box to the next: steeper is a step to another surface."""
_MIN_CORNER = 0.01
"""Change of this slope in an inner corner, where one thing stands on or at another, and behind a step."""
_MIN_BEYOND = 0.03
"""Share of the samples around a box that a surface must have to go on there."""
_BEYOND_OF_INSIDE = 0.15
"""The same as a part of its share of the samples in the box."""
_MIN_LEFT = 0.1
"""Share of the samples in a box that must be left, otherwise the object itself extends beyond its box."""


def is_on_surface_beyond(samples: BoxSamples, is_free: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the free samples (n, GRID, GRID), on no plane, are connected with many around the box."""
    numbers, count = _surface_numbers(samples, is_free)
    in_box = np.bincount(inside(numbers)[inside(is_free)], minlength=count) / SIDE**2
    beyond = np.bincount(around(numbers)[around(is_free)], minlength=count) / IS_AROUND.sum()
    is_beyond = (beyond >= _MIN_BEYOND) & (beyond > _BEYOND_OF_INSIDE * in_box)
    found = is_beyond[numbers]
    is_object_left = inside(is_free & ~found).mean(axis=(1, 2)) >= _MIN_LEFT
    return np.asarray(found & is_object_left[:, None, None])


def _surface_numbers(samples: BoxSamples, is_free: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """A number for each connected surface of free samples (n, GRID, GRID), and how many numbers there are."""
    logs = np.log(samples.metres, where=is_free, out=np.full_like(samples.metres, np.nan))
    # Every second pixel is a sample, those between are connections; an empty line separates the boxes.
    pixels = np.zeros((len(logs), 2 * GRID, 2 * GRID), np.uint8)
    pixels[:, ::2, ::2] = is_free
    pixels[:, ::2, 1:-1:2] = _is_connected(logs, samples.columns)
    pixels[:, 1:-1:2, ::2] = _is_connected(logs.transpose(0, 2, 1), samples.rows).transpose(0, 2, 1)
    count, numbers = cv2.connectedComponents(pixels.reshape(-1, 2 * GRID), connectivity=4)
    return np.asarray(numbers.reshape(pixels.shape)[:, ::2, ::2], np.int32), count


def _is_connected(logs: Array, places: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether samples next to each other along the last axis are on one surface (n, GRID, GRID - 1).

    `logs` (n, GRID, GRID) are those of the depths, NaN where none counts, `places` (n, GRID) the pixels.
    """
    gaps = np.diff(places, axis=1)[:, None]
    in_box = np.maximum((places[:, -RING - 1] - places[:, RING]) / (SIDE - 1), 1)[:, None, None]
    slopes = np.diff(logs, axis=2) * (in_box / np.maximum(gaps, 1)).astype(np.float32)
    slopes[~(abs(slopes) < _MAX_SLOPE)] = np.nan
    is_corner = np.zeros(logs.shape, np.bool_)
    is_corner[..., 1:-1] = np.diff(slopes, axis=2) < -_MIN_CORNER
    is_corner[..., 1:-1] &= (gaps[..., 1:] > 0) & (gaps[..., :-1] > 0)  # not within a pixel
    return np.asarray(~np.isnan(slopes) & ~is_corner[..., 1:] & ~is_corner[..., :-1])
