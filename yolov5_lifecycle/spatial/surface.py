"""Finds the surface of the object in each box.

A box also holds background, and often something nearer that hides a part of the object. Both extend beyond
the box, the object does not: planes and other surfaces that go on around the box are removed first, and of
what is left a depth counts by how much more frequent it is in the box than around it. Where the object's mask
is known, only what lies in it counts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.box_samples import (
    GRID,
    IS_AROUND,
    RING,
    SIDE,
    BoxSamples,
    around,
    inside,
    is_on_plane_beyond,
    is_on_surface_beyond,
    sampled,
)
from yolov5_lifecycle.spatial.camera_model import Intrinsics
from yolov5_lifecycle.spatial.depth_image import MIN_DEPTH_M, DepthImage

MAX_BOXES_AT_ONCE = 64
"""More boxes are looked at in several passes, so that the arrays stay small."""
_BIN_WIDTH = math.log(1.025)
"""Depths are counted in bins of 2.5 %, so that near and far objects are resolved equally well."""
_MIN_RING_SHARE = 0.25
"""Share of the samples around a box; fewer count for less, as at the edge of the image."""
_RING_WEIGHT = 1.5
"""Of what is around a box. More than 1, because a slope has other depths in the box than around it."""
_MIN_OF_PEAK = 0.5
"""Share of the excess of the highest peak: the nearest peak that reaches it is the object."""
_MIN_EXCESS = 0.03
"""Share of the samples in a box; less is noise: then only the depths in the box count."""
_SURFACE_END = 0.05
"""Share of the excess of the surface's peak: bins with less are a gap in the surface, or beyond it."""
_FULL_SURFACE_END = 0.2
"""The same where the background could not be told from the object."""
_MIN_KEPT = 0.01
"""The same as a share of the samples in a box."""
_GAP_BEFORE, _GAP_BEHIND = 1, 4
"""Bins without samples that a surface may reach across, as from a seat to the back, or from leg to leg."""
_GAP_TO_PART = 20
"""Bins that a part of the object may be farther behind, as the other legs of a table seen edge-on."""
_MIN_PART = 0.07
"""Excess of such a part."""
_BARRIER = -0.05
"""Excess of bins that a surface never reaches across: there is more of them around the box."""
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
_MIN_DENSE = 0.3
"""Share of measurements in a box from which on those without a neighbour are on no surface."""
_OUTLIERS = 0.002
"""Share of a surface's samples left out at each end."""
_NO_BIN = -9
"""Of a sample that does not count; more than two bins before all others."""
_MASK_MARGIN_PX = 2
"""Masks err that much at their edges; the background that comes along is known by its planes."""
_MIN_OF_MEASURED = 0.2
"""Share of measurements in a mask, as a part of that in and around the box: a black object has fewer."""

Array = NDArray[np.float32]
Bins = NDArray[np.int32]
Flags = NDArray[np.bool_]
Shares = NDArray[np.float64]


class ObjectMasks(Protocol):
    """Masks of detections, see `yolov5_lifecycle.detection.masks.Masks`."""

    def of(self, rows: NDArray[np.int64], /) -> ObjectMasks:
        """The masks of the detections with the indices `rows` (n,)."""

    def at(self, row: int, rows: NDArray[np.intp], columns: NDArray[np.intp], /) -> Flags:
        """Which pixels (r, c) in `rows` (r,) and `columns` (c,) of the image a detection's mask has."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """What the samples of n boxes show, evenly spread over the box, row by row."""

    boxes_xyxy: Array
    """(n, 4)."""
    metres: Array
    """(n, SIDE, SIDE) depth of the object's surface, NaN where it is not seen."""
    beside_m: Array
    """(n, SIDE, SIDE) depth of what is not the object, NaN elsewhere."""

    def __getitem__(self, rows: NDArray[np.intp]) -> Surfaces:
        """Those in the boxes with the indices `rows` (m,)."""
        return Surfaces(self.boxes_xyxy[rows], self.metres[rows], self.beside_m[rows])


def surfaces_in(
    boxes_xyxy: Array, depth: DepthImage, camera: Intrinsics, masks: ObjectMasks | None = None
) -> Surfaces:
    """The surfaces of the objects in the boxes (n, 4).

    Boxes are finite corners in pixels of the depth image, (0, 0) is the outer corner of its first pixel. The
    camera and the image in which the same objects have `masks` are of its size. A mask in which no object is
    found does not count, but an object that has no depth in its mask has no surface.
    """
    found = [np.zeros((2, 0, SIDE, SIDE), np.float32)]
    for first in range(0, len(boxes_xyxy), MAX_BOXES_AT_ONCE):
        rows = np.arange(first, min(first + MAX_BOXES_AT_ONCE, len(boxes_xyxy)))
        of_rows = None if masks is None else masks.of(rows)
        found.append(_surfaces_of(boxes_xyxy[rows], depth, camera, of_rows))
    return Surfaces(boxes_xyxy, *np.concatenate(found, axis=1))


def _surfaces_of(
    boxes_xyxy: Array, depth: DepthImage, camera: Intrinsics, masks: ObjectMasks | None
) -> Array:
    """Depth (2, n, SIDE, SIDE) of the objects, and of what is beside them, NaN elsewhere."""
    samples = sampled(depth, boxes_xyxy, camera)
    bins = _bins(samples.metres)
    foreground = np.where(is_on_plane_beyond(samples), np.int32(_NO_BIN), bins)
    # What goes on around the box is no object, and tells around it how far away others are.
    looks = [IS_AROUND | ~is_on_surface_beyond(samples, foreground >= 0)]
    foreground = _supported(foreground, samples, depth)
    is_done = np.zeros(len(bins), np.bool_)
    if masks is not None:
        in_mask, is_measured = _in_masks(masks, samples)
        looks, is_done = [in_mask, *looks], ~is_measured
    is_surface = np.zeros((len(bins), SIDE, SIDE), np.bool_)
    for find, is_counted in product((_foreground_surface, _any_surface), looks):
        if not is_done.all():
            left = ~is_done
            is_surface[left], is_done[left] = find(foreground[left], bins[left], is_counted[left])
    in_box = inside(samples.metres)
    metres = np.where(is_surface, in_box, np.float32(np.nan))
    return np.stack((_without_outliers(metres), np.where(is_surface, np.float32(np.nan), in_box)))


def _in_masks(masks: ObjectMasks, samples: BoxSamples) -> tuple[Flags, Flags]:
    """Which samples (n, GRID, GRID) may be of the object in a mask, and whether the camera measures it (n,).

    Those in the mask and within _MASK_MARGIN_PX, and all samples around the box.
    """
    beside = np.array((-_MASK_MARGIN_PX, 0, _MASK_MARGIN_PX))
    near, proper = np.ones((2, *samples.metres.shape), np.bool_)
    for row, (rows, columns) in enumerate(zip(samples.rows, samples.columns, strict=True)):
        places = (each[RING:-RING, None] + beside for each in (rows, columns))
        pixels = masks.at(row, *(each.ravel() for each in places)).reshape(SIDE, 3, SIDE, 3)
        inside(near)[row], inside(proper)[row] = pixels.any(axis=(1, 3)), pixels[:, 1, :, 1]
    is_measured = ~np.isnan(samples.metres)
    in_proper = inside(proper).sum(axis=(1, 2))
    measured = (inside(proper) & inside(is_measured)).sum(axis=(1, 2))
    return near, measured >= _MIN_OF_MEASURED * in_proper * is_measured.mean(axis=(1, 2))


def _bins(metres: Array) -> Bins:
    """Bin numbers >= 0 of the samples, _NO_BIN without a measurement."""
    bins = np.log(metres / np.float32(MIN_DEPTH_M)) / np.float32(_BIN_WIDTH)
    # A sample at MIN_DEPTH_M may come out a little below 0.
    return np.where(np.isnan(bins), np.float32(_NO_BIN), np.maximum(bins, 0)).astype(np.int32)


def _supported(foreground: Bins, samples: BoxSamples, depth: DepthImage) -> Bins:
    """The bins (n, GRID, GRID) of the foreground, without those in the box of pixels between two surfaces.

    Such a pixel's depth is that of no pixel next to it, and hardly that of a sample next to it.
    """
    places = np.nonzero(~IS_AROUND & (foreground >= 0))
    for beside, least in ((_BESIDE[:, :1], 0), (_BESIDE, _MIN_BESIDE)):  # most are like the pixel below
        is_alone = _is_alone(samples, places, depth, beside, least)
        places = tuple(indices[is_alone] for indices in places)
    supported = foreground.copy()
    supported[places] = _NO_BIN
    is_lonely = ~IS_AROUND & ~_has_neighbour(supported)
    is_lonely &= (~np.isnan(inside(samples.metres))).mean(axis=(1, 2))[:, None, None] >= _MIN_DENSE
    supported[is_lonely] = _NO_BIN
    return supported


def _has_neighbour(bins: Bins) -> Flags:
    """Whether one of the eight samples next to one is at most two bins away (n, GRID, GRID)."""
    padded = np.pad(bins, ((0, 0), (1, 1), (1, 1)), constant_values=2 * _NO_BIN)
    has = np.zeros(bins.shape, np.bool_)
    for down, right in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
        has |= abs(bins - padded[:, down : down + GRID, right : right + GRID]) <= 2
    return has


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


def _foreground_surface(foreground: Bins, bins: Bins, is_counted: Flags) -> tuple[Flags, Flags]:
    """Which samples (n, SIDE, SIDE) are on the surface before the background, and whether there is one (n,).

    `bins` (n, GRID, GRID) are those of all samples, `foreground` of those that are not background. In the
    box, only those with `is_counted` may be on the surface.
    """
    foreground, bins, valid_share = _counted(foreground, bins, is_counted)
    shares, shares_around, first = _shares(foreground, bins)
    excess = shares - _RING_WEIGHT * shares_around
    is_found = (excess.max(axis=1) >= _MIN_EXCESS) & (valid_share >= _MIN_VALID)
    ends = _surface_ends(excess, _SURFACE_END, _GAP_BEFORE, _GAP_BEHIND)
    return _is_between(inside(foreground), first, ends) & is_found[:, None, None], is_found


def _any_surface(foreground: Bins, bins: Bins, is_counted: Flags) -> tuple[Flags, Flags]:
    """The same of an object that is as far away as its background, or fills the image."""
    _, bins, valid_share = _counted(foreground, bins, is_counted)
    shares, shares_around, first = _shares(bins, bins)
    excess = shares - _RING_WEIGHT * shares_around
    is_alone = excess.max(axis=1) < _MIN_EXCESS
    excess[is_alone] = shares[is_alone]
    ends = _surface_ends(excess, _FULL_SURFACE_END, 0, 0)
    is_found = valid_share >= np.where(is_alone, _MIN_VALID_ALONE, _MIN_VALID)
    return _is_between(inside(bins), first, ends) & is_found[:, None, None], is_found


def _counted(foreground: Bins, bins: Bins, is_counted: Flags) -> tuple[Bins, Bins, Shares]:
    """The bins of what counts, and the share (n,) of what counts in the box that is a measurement."""
    foreground, bins = (np.where(is_counted, each, np.int32(_NO_BIN)) for each in (foreground, bins))
    counted = inside(is_counted).sum(axis=(1, 2))
    return foreground, bins, (inside(bins) >= 0).sum(axis=(1, 2)) / np.maximum(counted, 1)


def _is_between(bins: Bins, first: int, ends: tuple[NDArray[np.intp], NDArray[np.intp]]) -> Flags:
    """Whether samples (n, SIDE, SIDE) lie in the bins from one end to the other, which count from `first`."""
    start, last = (end[:, None, None] + first for end in ends)
    return np.asarray((bins >= np.maximum(start, 0)) & (bins <= last))


def _shares(counted: Bins, bins: Bins) -> tuple[Shares, Shares, int]:
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


def _surface_ends(
    excess: Shares, end_share: float, gap_before: int, gap_behind: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last bin (n,) of the surface around the nearest peak of each box's excess (n, count)."""
    is_peak = excess >= _MIN_OF_PEAK * excess.max(axis=1, keepdims=True)
    is_peak[:, :-1] &= excess[:, :-1] >= excess[:, 1:]
    peak = is_peak.argmax(axis=1)  # the one before the first such bin is lower, or it would be the first
    is_kept = excess > np.maximum(end_share * np.take_along_axis(excess, peak[:, None], axis=1), _MIN_KEPT)
    is_barrier, is_part = excess < _BARRIER, (excess >= _MIN_PART) & (gap_behind > 0)
    last = excess.shape[1] - 1
    return (
        last
        - _last_kept(is_kept[:, ::-1], is_barrier[:, ::-1], np.zeros_like(is_part), last - peak, gap_before),
        _last_kept(is_kept, is_barrier, is_part, peak, gap_behind),
    )


def _last_kept(
    is_kept: Flags, is_barrier: Flags, is_part: Flags, peak: NDArray[np.intp], gap: int
) -> NDArray[np.intp]:
    """The last kept bin (n,) after the peak, with at most `gap` others between two, and no barrier.

    To a bin that is a part of its own, there may be _GAP_TO_PART others.
    """
    bins, peaks = np.arange(is_kept.shape[1]), peak[:, None]
    reached = np.maximum.accumulate(np.where(is_kept & (bins > peaks), bins, peaks), axis=1)
    next_part = np.where(is_part, bins, 2 * len(bins) + _GAP_TO_PART)
    next_part = np.minimum.accumulate(next_part[:, ::-1], axis=1)[:, ::-1]
    is_gap = (bins - reached > gap) & (next_part - reached > _GAP_TO_PART)
    is_stop = (bins > peaks) & (is_gap | is_barrier)
    stop = np.where(is_stop, bins, bins[-1]).min(axis=1)
    return np.take_along_axis(reached, stop[:, None], axis=1)[:, 0]


def _without_outliers(metres: Array) -> Array:
    """The same samples (n, SIDE, SIDE), the nearest and farthest few as far away as those next to them."""
    ordered = np.sort(metres.reshape(len(metres), -1), axis=1)  # NaN comes last
    last = (~np.isnan(ordered)).sum(axis=1) - 1
    places = np.rint(last[:, None] * np.array((_OUTLIERS, 1 - _OUTLIERS))).astype(np.intp)
    near, far = np.take_along_axis(ordered, places.clip(0), axis=1).T[:, :, None, None]
    return metres.clip(near, far)
