"""What all boxes of an image have in common, from the boxes alone: a camera that moved unexpectedly.

A Kalman filter like that of one box (`motion.py`), for how far the predictions of all tracks are off. What it
finds is added to all tracks, lost ones included, so that only the uncertainty remains here. The noise of the
acceleration follows the innovations, so that little is added while a camera stands still.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from yolov5_lifecycle.tracking.motion import Array, Similarity, corrected_variances, later_variances

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


class Correction(NamedTuple):
    """What the tracks gain: their places are mapped, then their velocities grow."""

    similarity: Similarity
    velocity_xy: Array
    """(2,) pixels per second."""


class CommonMotion:
    """The common error of the predicted boxes of one camera; x and y are independent."""

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
