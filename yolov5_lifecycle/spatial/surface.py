"""Finds the surface of the object in each box from samples of its depth.

The samples lie on a grid in and around the box, so that the cost does not depend on the size of the box.

A box also holds background, and often something nearer that hides a part of the object. Both extend beyond
the box, the object does not: a depth counts by how much more frequent it is in the box than around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.depth_image import MIN_DEPTH_M, DepthImage

SIDE = 20
"""Samples along each side of a box."""
_RING = np.array((0.12, 0.19, 0.26), np.float32)
"""Distances from the box, in parts of its side: far enough for a box that is a little too small."""
_MIN_RING_PX = np.array((2, 3, 4), np.float32)
_FAR_PX = 1e6
"""Far outside every image, and still an integer after a margin is added."""
_INSIDE = (np.arange(SIDE, dtype=np.float32) + 0.5) / SIDE

_BIN_WIDTH = math.log(1.025)
"""Depths are counted in bins of 2.5 %, so that near and far objects are resolved equally well."""
_RING_WEIGHT = 2.5
"""More than 1, because a slope behind the object has other depths around the box than in it."""
_MIN_RING_SHARE = 0.25
"""Share of the samples around a box; fewer count for less, as at the edge of the image."""
_MIN_EXCESS = 0.03
"""Share of the samples in a box; less is noise: then only the depths in the box count."""
_MIN_OF_PEAK = 0.2
"""Share of the excess of the highest peak: the nearest peak that reaches it is the object."""
_SURFACE_END = 0.2
"""Share of the excess of the surface's peak: the surface ends where the excess falls below it."""
_MIN_VALID = 0.05
"""Share of the samples in a box that must be measurements."""
_MIN_VALID_ALONE = 0.5
"""The same if the ring does not single out the object: a black object has only its background's depth."""
_OUTLIERS = 0.03
"""Share of a surface's samples left out at each end: pixels between two surfaces, and noise."""


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


def surface_extents_m(samples: BoxSamples) -> NDArray[np.float64]:
    """Nearest and farthest depth (n, 2) in metres of the surface in each box; NaN where there is none."""
    inside, around = _bins(samples.inside), _bins(samples.around)
    valid = (inside >= 0).mean(axis=1)
    first, count = _used_bins(inside)
    share = _shares(inside, first, count, min_valid=0.0)
    excess = share - _RING_WEIGHT * _shares(around, first, count, min_valid=_MIN_RING_SHARE)
    is_alone = excess.max(axis=1) < _MIN_EXCESS
    excess[is_alone] = share[is_alone]
    start, end = _surface_bins(excess)
    is_surface = (inside >= 0) & (inside >= first + start[:, None]) & (inside < first + end[:, None])
    is_found = valid >= np.where(is_alone, _MIN_VALID_ALONE, _MIN_VALID)
    return _extents_m(samples.inside, is_surface & is_found[:, None])


def _bins(metres: NDArray[np.float32]) -> NDArray[np.intp]:
    """Bin numbers >= 0 of the samples, -1 without a measurement."""
    bins = np.log(metres / np.float32(MIN_DEPTH_M)) / np.float32(_BIN_WIDTH)
    # A sample at MIN_DEPTH_M may come out a little below 0.
    return np.where(np.isnan(bins), np.float32(-1), np.maximum(bins, 0)).astype(np.intp)


def _used_bins(bins: NDArray[np.intp]) -> tuple[int, int]:
    """First bin and number of bins that hold samples, and two more at each end, which `_shares` looks at."""
    last = int(bins.max())
    first = int(bins.min(initial=last, where=bins >= 0))
    return first - 2, last - first + 5


def _shares(bins: NDArray[np.intp], first: int, count: int, *, min_valid: float) -> NDArray[np.float64]:
    """For each box and each of `count` bins, the share of measurements (n, count) in it and its neighbours.

    `bins` are those of all samples (n, s). Where fewer than `min_valid` of the samples are measurements, the
    shares are of that many.
    """
    boxes, size = bins.shape
    # Each box has an extra place before its bins, for samples in none of them.
    is_counted = (bins >= first) & (bins < first + count) & (bins >= 0)
    places = np.where(is_counted, bins - first + 1, 0) + np.arange(boxes)[:, None] * (count + 1)
    counts = np.bincount(places.ravel(), minlength=boxes * (count + 1)).reshape(boxes, count + 1)[:, 1:]
    valid = (bins >= 0).sum(axis=1, keepdims=True)
    share = counts / np.maximum(valid, max(size * min_valid, 1))
    blurred: NDArray[np.float64] = share.copy()
    blurred[:, 1:] += share[:, :-1]
    blurred[:, :-1] += share[:, 1:]
    return blurred


def _surface_bins(excess: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First bin (n,) of the nearest peak of each box's excess (n, bins), and the one after its last."""
    boxes, count = np.arange(len(excess)), excess.shape[1]
    is_peak = excess >= _MIN_OF_PEAK * excess.max(axis=1, keepdims=True)
    is_peak[:, :-1] &= excess[:, :-1] >= excess[:, 1:]
    peak = is_peak.argmax(axis=1)  # the one before the first such bin is lower, or it would be the first
    is_beyond = excess <= _SURFACE_END * excess[boxes, peak][:, None]
    bins = np.arange(count)
    start = np.where(is_beyond & (bins <= peak[:, None]), bins + 1, 0).max(axis=1)
    end = np.where(is_beyond & (bins >= peak[:, None]), bins, count).min(axis=1)
    return start, end


def _extents_m(metres: NDArray[np.float32], is_surface: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Nearest and farthest (n, 2) of the chosen samples (n, s) without outliers; NaN where none is chosen."""
    ordered = np.sort(np.where(is_surface, metres, np.float32(np.inf)), axis=1)
    last = is_surface.sum(axis=1) - 1
    places = np.rint(last[:, None] * np.array((_OUTLIERS, 1 - _OUTLIERS))).astype(np.intp)
    extents = np.take_along_axis(ordered, places.clip(0), axis=1).astype(np.float64)
    return np.where(np.isfinite(extents), extents, np.nan)
