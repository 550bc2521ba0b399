"""Finds the surface of the object in each box.

A box also holds background, and often something nearer that hides a part of the object. Both extend beyond
the box, the object does not: planes that go on around the box are removed first, and of what is left a depth
counts by how much more frequent it is in the box than around it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.box_samples import (
    IS_AROUND,
    BoxSamples,
    around,
    inside,
    is_background,
    sampled,
)
from yolov5_lifecycle.spatial.depth_image import MIN_DEPTH_M, DepthImage

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
_SURFACE_END = 0.06
"""Share of the excess of the surface's peak: bins with less are a gap in the surface, or beyond it."""
_MIN_KEPT = 0.01
"""The same as a share of the samples in a box."""
_GAP = 4
"""Bins without samples that a surface may reach across, as from a seat to the back."""
_MIN_VALID = 0.05
"""Share of the samples in a box that must be measurements."""
_MIN_VALID_ALONE = 0.5
"""The same if the ring does not single out the object: a black object has only its background's depth."""
_BESIDE = np.array(((1, -1, 0, 0), (0, 0, 1, -1)))[..., None]
"""Rows and columns to the pixels next to one, (2, 4, 1)."""
_SAME = 0.02
"""Of the depth: pixels next to each other that differ by less are on the same surface."""
_MIN_BESIDE = 2
"""Of the four pixels next to one, the measured ones without which it counts as on a surface."""
_NO_BIN = -9
"""Of a sample that does not count; before all others."""

Array = NDArray[np.float32]
Bins = NDArray[np.int32]
Flags = NDArray[np.bool_]


def surfaces_m(depth: DepthImage, boxes_xyxy: NDArray[np.float32]) -> Array:
    """Depth in metres (n, SIDE, SIDE) of the surface of the object in each of the boxes (n, 4).

    The samples are evenly spread over the box, row by row; NaN where the object is not seen. Boxes are
    finite corners in pixels of the depth image.
    """
    samples = sampled(depth, boxes_xyxy)
    bins = _bins(samples.metres)
    foreground = np.where(is_background(samples), np.int32(_NO_BIN), bins)
    is_surface, stands_out = _surface(_supported(foreground, samples, depth), bins)
    if not stands_out.all():  # as far away as the background, or it fills the image
        is_surface[~stands_out], _ = _surface(bins[~stands_out], bins[~stands_out])
    return np.where(is_surface, inside(samples.metres), np.float32(np.nan))


def _bins(metres: Array) -> Bins:
    """Bin numbers >= 0 of the samples, _NO_BIN without a measurement."""
    bins = np.log(metres / np.float32(MIN_DEPTH_M)) / np.float32(_BIN_WIDTH)
    # A sample at MIN_DEPTH_M may come out a little below 0.
    return np.where(np.isnan(bins), np.float32(_NO_BIN), np.maximum(bins, 0)).astype(np.int32)


def _supported(foreground: Bins, samples: BoxSamples, depth: DepthImage) -> Bins:
    """The bins (n, GRID, GRID) of the foreground, without those in the box of pixels between two surfaces.

    Such a pixel's depth is that of no pixel next to it.
    """
    places = np.nonzero(~IS_AROUND & (foreground >= 0))
    for beside, least in ((_BESIDE[:, :1], 0), (_BESIDE, _MIN_BESIDE)):  # most are like the pixel below
        is_alone = _is_alone(samples, places, depth, beside, least)
        places = tuple(indices[is_alone] for indices in places)
    supported = foreground.copy()
    supported[places] = _NO_BIN
    return supported


def _is_alone(
    samples: BoxSamples,
    places: tuple[NDArray[np.intp], ...],
    depth: DepthImage,
    beside: NDArray[np.intp],
    least: int,
) -> Flags:
    """Whether the samples at those places in `samples` are as far away as none of the pixels beside them.

    False if fewer than `least` of these are measured, as in sparse depth.
    """
    box, row, column = places
    metres = samples.metres[places]
    metres_beside = depth.metres_at(
        samples.rows[box, row] + beside[0], samples.columns[box, column] + beside[1]
    )
    is_same = abs(metres_beside - metres) < _SAME * metres
    is_told = (~np.isnan(metres_beside)).sum(axis=0) >= least
    return np.asarray(is_told & ~is_same.any(axis=0))


def _surface(counted: Bins, bins: Bins) -> tuple[Flags, Flags]:
    """Which samples (n, SIDE, SIDE) are on the object's surface, and whether that stands out (n,).

    `bins` (n, GRID, GRID) are those of all samples, `counted` of those that may be on the object. Where
    nothing stands out from what is around the box, the depths in the box alone decide. No sample is on a
    surface if too few are measurements.
    """
    shares, shares_around, first = _shares(counted, bins)
    excess = shares - _RING_WEIGHT * shares_around
    stands_out = excess.max(axis=1) >= _MIN_EXCESS
    excess[~stands_out] = shares[~stands_out]
    is_measured = (inside(bins) >= 0).mean(axis=(1, 2)) >= np.where(stands_out, _MIN_VALID, _MIN_VALID_ALONE)
    start, last = (end[:, None, None] + first for end in _surface_ends(excess))
    is_between = (inside(counted) >= np.maximum(start, 0)) & (inside(counted) <= last)
    return is_between & is_measured[:, None, None], stands_out & is_measured


def _shares(counted: Bins, bins: Bins) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
    """Shares (n, count) of measurements in each bin and its neighbours, in and around boxes; the first bin.

    `bins` (n, GRID, GRID) are those of all measurements, `counted` of those of which the share is.
    """
    # Two bins more than are used at each end, for neighbours and a fall.
    last = max(int(inside(bins).max()), 0)
    first = int(np.where(inside(bins) >= 0, inside(bins), last).min()) - 2
    count = last - first + 3
    measured = (inside(bins) >= 0).sum(axis=(1, 2))
    measured_around = (around(bins) >= 0).sum(axis=1)
    least = _MIN_RING_SHARE * IS_AROUND.sum()
    return (
        _counts(inside(counted), first, count) / np.maximum(measured, 1)[:, None],
        _counts(around(counted), first, count) / np.maximum(measured_around, least)[:, None],
        first,
    )


def _counts(bins: Bins, first: int, count: int) -> NDArray[np.float64]:
    """For each box and each of `count` bins, the number (n, count) of samples in it and its neighbours."""
    boxes = len(bins)
    flat = bins.reshape(boxes, -1)
    # Each box has an extra place before its bins, for samples in none of them.
    is_counted = (flat >= max(first, 0)) & (flat < first + count)
    places = np.where(is_counted, flat - first + 1, 0) + np.arange(boxes)[:, None] * (count + 1)
    counts = np.bincount(places.ravel(), minlength=boxes * (count + 1)).reshape(boxes, count + 1)[:, 1:]
    blurred = counts.astype(np.float64)
    blurred[:, 1:] += counts[:, :-1]
    blurred[:, :-1] += counts[:, 1:]
    return blurred


def _surface_ends(excess: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last bin (n,) of the surface around the nearest peak of each box's excess (n, count)."""
    is_peak = excess >= _MIN_OF_PEAK * excess.max(axis=1, keepdims=True)
    is_peak[:, :-1] &= excess[:, :-1] >= excess[:, 1:]
    peak = is_peak.argmax(axis=1)  # the one before the first such bin is lower, or it would be the first
    of_peak = np.take_along_axis(excess, peak[:, None], axis=1)
    is_kept = excess > np.maximum(_SURFACE_END * of_peak, _MIN_KEPT)
    last = excess.shape[1] - 1
    return last - _last_kept(is_kept[:, ::-1], last - peak), _last_kept(is_kept, peak)


def _last_kept(is_kept: Flags, peak: NDArray[np.intp]) -> NDArray[np.intp]:
    """The last kept bin (n,) after the peak, with at most _GAP others between two."""
    bins, peaks = np.arange(is_kept.shape[1]), peak[:, None]
    reached = np.maximum.accumulate(np.where(is_kept & (bins > peaks), bins, peaks), axis=1)
    stop = np.where(bins - reached > _GAP, bins, bins[-1]).min(axis=1)
    return np.take_along_axis(reached, stop[:, None], axis=1)[:, 0]
