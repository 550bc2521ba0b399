"""Tracks and the motion of their boxes.

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

    @property
    def margin_xy(self) -> Array:
        """(n, 2) standard deviation of the centre in pixels, at most MAX_MARGIN."""
        return np.minimum(np.sqrt(self.variances[:, 0, :2]), MAX_MARGIN * _size(self.position))

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
        variance, covariance, velocity_variance = self.variances.transpose(1, 0, 2)
        drift = covariance + velocity_variance * step_s
        variances = np.empty_like(self.variances)
        variances[:, 0] = variance + (covariance + drift) * step_s + density * (step_s**3 / 3)
        variances[:, 1] = drift + density * (step_s**2 / 2)
        variances[:, 2] = velocity_variance + density * step_s
        return replace(self, estimates=estimates, variances=variances, unseen_s=self.unseen_s + step_s)

    def seen_from(self, camera: Similarity) -> Tracks:
        """The tracks in an image to whose pixels `camera` maps those of the last one."""
        linear, scale = camera[:, :2].T, float(np.hypot(*camera[:, 0]))
        estimates = _transformed(self.estimates, linear, scale)
        estimates[:, 0, :2] += camera[:, 2]
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
        of_position, of_velocity = self.variances[:, :2], self.variances[:, 2:]
        rest = of_velocity - gain[:, 1:] * of_position[:, 1:]
        return replace(
            self,
            estimates=self.estimates + gain * (measured - self.position)[:, None],
            variances=np.concatenate((of_position * (1 - gain[:, :1]), rest), axis=1),
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
