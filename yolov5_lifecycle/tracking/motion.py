"""Tracks, the motion of their boxes, and what this has in common: a camera that moved unexpectedly.

Each coordinate of each box has a Kalman filter of constant velocity.

A box is its centre and size (cx, cy, w, h), as in BoT-SORT (Aharon et al. 2022). The four are independent of
each other, so instead of one filter with a state of eight there are four with a state of two, position and
velocity. Everything is elementwise, without a matrix to invert.

Noise is proportional to the size of the box, as in DeepSORT (Wojke et al. 2017), and that of the motion grows
with time instead of frames: it is the continuous white noise acceleration of Bar-Shalom, Li and Kirubarajan,
"Estimation with Applications to Tracking and Navigation" (2001), section 6.2.2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Similarity = NDArray[np.float64]
"""(2, 3): turns, scales and shifts points (x, y, 1)."""

UNCONFIRMED = 0
"""The number of a track that was seen once."""
MEASUREMENT_STD = 0.03
"""Standard deviation of a detected coordinate in box sizes, for a score of 1; see `measurement_std`."""
SAME_ERROR_S = 0.2
"""Time for which a detector repeats the same error; more images within it add no information."""
MIN_SCORE = 0.05
"""Scores below count as this one."""
START_SPEED_STD = np.array((2.0, 2.0, 0.25, 0.25))
"""Standard deviation of the velocity of a new track, in box sizes per second; DeepSORT's at 30 Hz is 1.9."""
ACCELERATION_DENSITY = np.array((0.5, 0.5, 0.05, 0.05)) ** 2
"""Variance that the velocity gains per second, in (box sizes / s)^2 / s. DeepSORT's at 30 Hz is 1.05: with it
the velocity follows the box of an object that shrinks because it passes behind another one."""
MAX_MARGIN = 0.5
"""Largest margin of a predicted box, in box sizes."""
MIN_SIZE_PX = 1.0
"""Smallest size that scales the noise, so that an empty box has some, too."""

MIN_BOXES = 3
"""With fewer boxes, what they have in common may be their own motion."""
MIN_BOXES_TO_TURN = 5
"""With fewer boxes there is no turn and no zoom."""
_MIN_DENSITY, _MAX_DENSITY = 0.01, 200.0
"""Of the variance that the velocity gains per second, in (box sizes / s)^2 / s."""
_ADAPTION = 0.3
"""How much of the normalised innovation, less the expected 1, the density's logarithm gains per image."""
_MAX_INNOVATION = 10.0
"""A larger normalised innovation counts as this one."""
_MIN_SPREAD = 0.04
"""Of the surprises of single boxes, in box sizes: the standard deviation of a detected centre."""
_MIN_SIGNIFICANCE = 9.0
"""Of turn and zoom, as a squared number of standard deviations."""
_ROUNDS = 3  # of robust least squares


@dataclass(frozen=True, eq=False)
class Tracks:
    """n tracks as parallel arrays; estimates are of cx, cy, w and h, in pixels and seconds."""

    estimates: Array
    """(n, 2, 4): position and velocity."""
    variances: Array
    """(n, 3, 4): variance of the position, its covariance with the velocity, variance of the velocity."""
    class_ids: NDArray[np.int64]
    """(n,) class of the detection that each was last seen in."""
    numbers: NDArray[np.int64]
    """(n,) UNCONFIRMED, or unique and above 0."""
    unseen_s: Array
    """(n,) seconds since each was seen."""

    @classmethod
    def started(
        cls, boxes_xyxy: NDArray[np.floating], scores: NDArray[np.floating], class_ids: NDArray[np.int64]
    ) -> Tracks:
        """Unconfirmed tracks that were seen once, in `boxes_xyxy` (n, 4) with `scores` (n,)."""
        position = xyxy_to_cxcywh(boxes_xyxy)
        still = np.zeros_like(position)
        variance = still + measurement_std(position, scores, SAME_ERROR_S) ** 2
        speed_variance = (START_SPEED_STD * _size(position)) ** 2
        return cls(
            np.stack((position, still), axis=1),
            np.stack((variance, still, speed_variance), axis=1),
            class_ids,
            np.full(len(scores), UNCONFIRMED, np.int64),
            np.zeros(len(scores)),
        )

    @classmethod
    def none(cls) -> Tracks:
        """No tracks."""
        return cls.started(np.zeros((0, 4)), np.zeros(0), np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def position(self) -> Array:
        """(n, 4) centre and size in pixels."""
        return self.estimates[:, 0]

    @property
    def is_confirmed(self) -> NDArray[np.bool_]:
        """(n,) whether each has a number."""
        return np.not_equal(self.numbers, UNCONFIRMED)

    @property
    def boxes_xyxy(self) -> Array:
        """(n, 4) corners in pixels."""
        centre, half_size = self.position[:, :2], self.position[:, 2:] / 2
        return np.concatenate((centre - half_size, centre + half_size), axis=1)

    def margin_xy(self, common_variance_xy: Array | float = 0.0) -> Array:
        """(n, 2) standard deviation of the centre in pixels, at most MAX_MARGIN.

        `common_variance_xy` (2,) is that of all centres together, in pixels squared.
        """
        std = np.sqrt(self.variances[:, 0, :2] + common_variance_xy)
        return np.minimum(std, MAX_MARGIN * _size(self.position))

    @property
    def usual_size_px(self) -> float:
        """Median over the tracks, of which there must be one, of the mean of width and height."""
        return float(np.median(_size(self.position)))

    def later(self, step_s: float, timeout_s: float) -> Tracks:
        """The tracks `step_s` seconds later, without those unseen for more than `timeout_s`."""
        kept = self.at(self.unseen_s + step_s <= timeout_s)
        return kept.predicted(min(step_s, timeout_s))

    def predicted(self, step_s: float) -> Tracks:
        """The tracks `step_s` seconds later; a box does not shrink below an empty one."""
        estimates = self.estimates.copy()
        estimates[:, 0] += estimates[:, 1] * step_s
        np.maximum(estimates[:, 0, 2:], 0, out=estimates[:, 0, 2:])
        density = ACCELERATION_DENSITY * _size(self.position) ** 2
        variances = later_variances(self.variances, density, step_s)
        return replace(self, estimates=estimates, variances=variances, unseen_s=self.unseen_s + step_s)

    def seen_from(self, camera: Similarity, velocity_xy: Array | float = 0.0) -> Tracks:
        """The tracks in an image to whose pixels `camera` maps those of the last one.

        `velocity_xy` (2,) is added to the velocity of all centres.
        """
        linear, scale = camera[:, :2].T, float(np.hypot(*camera[:, 0]))
        estimates = _transformed(self.estimates, linear, scale)
        estimates[:, 0, :2] += camera[:, 2]
        estimates[:, 1, :2] += velocity_xy
        return replace(self, estimates=estimates, variances=_transformed(self.variances, linear**2, scale**2))

    def corrected(
        self, boxes_xyxy: NDArray[np.floating], scores: NDArray[np.floating], step_s: float
    ) -> Tracks:
        """The tracks after each was seen in its row of `boxes_xyxy` (n, 4) and `scores` (n,).

        `step_s`: seconds since the previous image.
        """
        measured = xyxy_to_cxcywh(boxes_xyxy)
        noise = measurement_std(measured, scores, step_s)[:, None] ** 2
        gain = self.variances[:, :2] / (self.variances[:, :1] + noise)
        return replace(
            self,
            estimates=self.estimates + gain * (measured - self.position)[:, None],
            variances=corrected_variances(self.variances, gain),
            unseen_s=np.zeros(len(self)),
        )

    def at(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Tracks:
        """The tracks in `rows`, indices or a mask."""
        return Tracks(*(column[rows] for column in vars(self).values()))

    def followed_by(self, other: Tracks) -> Tracks:
        """These tracks, then those of `other`."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Tracks(*map(np.concatenate, pairs))


def _transformed(values: Array, linear: Array, scale: float) -> Array:
    """The `values` (n, k, 4) of centres, mapped by `linear` (2, 2), and of sizes, times `scale`."""
    rows = values.reshape(-1, 4)
    return np.hstack((rows[:, :2] @ linear, rows[:, 2:] * scale)).reshape(values.shape)


def later_variances(variances: Array, density: Array | float, step_s: float) -> Array:
    """The `variances` (..., 3, k) of a `Tracks`, `step_s` seconds later.

    `density` (..., k): the variance that the velocity gains per second, in (pixels / s)^2 / s.
    """
    variance, covariance, velocity_variance = (variances[..., part, :] for part in range(3))
    drift = covariance + velocity_variance * step_s
    later = np.empty_like(variances)
    later[..., 0, :] = variance + (covariance + drift) * step_s + density * (step_s**3 / 3)
    later[..., 1, :] = drift + density * (step_s**2 / 2)
    later[..., 2, :] = velocity_variance + density * step_s
    return later


def corrected_variances(variances: Array, gain: Array) -> Array:
    """The `variances` (..., 3, k) after a measurement, by the `gain` (..., 2, k) of both estimates."""
    of_position, of_velocity = variances[..., :2, :], variances[..., 2:, :]
    rest = of_velocity - gain[..., 1:, :] * of_position[..., 1:, :]
    return np.concatenate((of_position * (1 - gain[..., :1, :]), rest), axis=-2)


def xyxy_to_cxcywh(boxes_xyxy: NDArray[np.floating]) -> Array:
    """Corners (n, 4) -> centre and size (n, 4)."""
    corners = boxes_xyxy.astype(np.float64)
    low, high = corners[:, :2], corners[:, 2:]
    return np.concatenate(((low + high) / 2, high - low), axis=1)


def measurement_std(boxes_cxcywh: Array, scores: NDArray[np.floating], step_s: float) -> Array:
    """(n, 1) standard deviation in pixels of boxes (n, 4) with `scores` (n,), `step_s` after the last image.

    It grows with a falling score, as in the NSA Kalman filter (Du et al. 2021): an object seen in part has a
    lower score and a box of that part alone, which says less about its position and motion. It also grows
    with the number of images in SAME_ERROR_S, so that together they count as one: all rates behave alike.
    """
    trust = np.maximum(scores.astype(np.float64)[:, None], MIN_SCORE) ** 2
    images = max(SAME_ERROR_S / step_s, 1.0)
    return np.asarray(MEASUREMENT_STD * math.sqrt(images) * _size(boxes_cxcywh) / trust)


def _size(position: Array) -> Array:
    """(n, 1) mean of width and height in pixels."""
    return np.asarray(np.maximum(position[:, 2:].mean(axis=1, keepdims=True), MIN_SIZE_PX))


class Correction(NamedTuple):
    """What the tracks gain: their places are mapped, then their velocities grow."""

    similarity: Similarity
    velocity_xy: Array
    """(2,) pixels per second."""


class CommonMotion:
    """What all boxes of a camera's image have in common, from the boxes alone.

    A Kalman filter like that of one box, for how far the predictions of all tracks are off; x and y are
    independent. What it finds is added to all tracks, lost ones included, so that only the uncertainty
    remains here. The noise of the acceleration follows the innovations, so that little is added while a
    camera stands still.
    """

    def __init__(self) -> None:
        self._density = _MIN_DENSITY
        self._variances = np.zeros((3, 2))
        """Of place and velocity, see `Tracks.variances`."""

    @property
    def variance_xy(self) -> Array:
        """(2,) of a predicted place, in pixels squared, besides that of its own track."""
        return np.asarray(self._variances[0])

    def predict(self, step_s: float, size_px: float) -> None:
        """Let `step_s` seconds pass; `size_px`: of a usual box."""
        self._variances = later_variances(self._variances, self._density * size_px**2, step_s)

    def correct(self, predicted_xy: Array, seen_xy: Array, size_px: float) -> Correction | None:
        """What the tracks gain as centres were `predicted_xy` (n, 2) and are `seen_xy` (n, 2).

        None for fewer than MIN_BOXES, which say nothing about a camera.
        """
        if len(seen_xy) < MIN_BOXES:
            # Certain again: without measurements the uncertainty would grow for ever.
            self._variances = np.zeros((3, 2))
            self._adapt(0.0)
            return None
        surprise = seen_xy - predicted_xy
        middle = np.median(surprise, axis=0)
        spread = np.maximum(1.48 * np.median(np.abs(surprise - middle), axis=0), _MIN_SPREAD * size_px)
        uncertainty = self.variance_xy + (1.25 * spread) ** 2 / len(surprise)  # of a median
        self._adapt(float(np.minimum(middle**2 / uncertainty, _MAX_INNOVATION).mean()))
        gain = self._variances[:2] / uncertainty
        self._variances = corrected_variances(self._variances, gain)
        shift_xy, velocity_xy = gain * middle
        turn = _turn(predicted_xy + shift_xy, surprise - middle, _MIN_SPREAD * size_px)
        turn[:, 2] += turn[:, :2] @ shift_xy
        return Correction(turn, velocity_xy)

    def _adapt(self, innovation: float) -> None:
        density = self._density * math.exp(_ADAPTION * (innovation - 1))
        self._density = min(max(density, _MIN_DENSITY), _MAX_DENSITY)


def _turn(places_xy: Array, surprise_xy: Array, min_spread_px: float) -> Similarity:
    """The turn and zoom (2, 3) around the middle of `places_xy` (n, 2) that `surprise_xy` (n, 2) follow.

    Robust least squares with Huber's weights. What is not significant is the identity.
    """
    if len(places_xy) < MIN_BOXES_TO_TURN:
        return np.eye(2, 3)
    middle = places_xy.mean(axis=0)
    arms = places_xy - middle
    across = np.stack((-arms[:, 1], arms[:, 0]), axis=1)
    weights = np.ones(len(arms))
    zoom = turn = significance = 0.0
    for _ in range(_ROUNDS):
        total = float((weights * (arms**2).sum(axis=1)).sum())
        if total <= 0:
            return np.eye(2, 3)
        zoom = float((weights * (arms * surprise_xy).sum(axis=1)).sum()) / total
        turn = float((weights * (across * surprise_xy).sum(axis=1)).sum()) / total
        rest = np.linalg.norm(surprise_xy - zoom * arms - turn * across, axis=1)
        scale = max(1.2 * float(np.median(rest)), min_spread_px)
        weights = 1 / np.maximum(rest / scale, 1.0)
        significance = (zoom**2 + turn**2) * total / scale**2
    if significance < _MIN_SIGNIFICANCE:
        return np.eye(2, 3)
    gain = 1 - _MIN_SIGNIFICANCE / 2 / significance
    linear = np.array(((1 + gain * zoom, -gain * turn), (gain * turn, 1 + gain * zoom)))
    return np.column_stack((linear, middle - linear @ middle))
