"""The motion of boxes: the textbook's Kalman filter, in seconds."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from yolov5_lifecycle.tracking.motion import (
    ACCELERATION_DENSITY,
    SAME_ERROR_S,
    START_SPEED_STD,
    Tracks,
    measurement_std,
    xyxy_to_cxcywh,
)

Array = NDArray[np.float64]
COORDINATES = range(4)
SURE = np.array([0.9])
seconds = st.floats(0.001, 2.0)
scores = st.floats(0, 1).map(lambda score: np.array([score]))
boxes = st.tuples(st.floats(-500, 1000), st.floats(-500, 1000), st.floats(1, 600), st.floats(1, 600)).map(
    lambda box: np.array([[box[0], box[1], box[0] + box[2], box[1] + box[3]]])
)


def started(boxes_xyxy: NDArray[np.floating], scores: Array) -> Tracks:
    return Tracks.started(boxes_xyxy, scores, np.zeros(len(scores), np.int64))


@dataclasses.dataclass
class TextbookFilter:
    """One coordinate of one box, with matrices."""

    state: Array
    covariance: Array

    @classmethod
    def started(cls, value: float, std: float, speed_std: float) -> TextbookFilter:
        variances = (std**2, speed_std**2)
        return cls(np.array((value, 0.0)), np.diag(variances))

    def predict(self, step_s: float, size: float, coordinate: int) -> None:
        transition = np.array(((1, step_s), (0, 1)))
        noise = np.array(((step_s**3 / 3, step_s**2 / 2), (step_s**2 / 2, step_s)))
        self.state = transition @ self.state
        self.covariance = transition @ self.covariance @ transition.T
        self.covariance += noise * ACCELERATION_DENSITY[coordinate] * size**2

    def correct(self, value: float, std: float) -> None:
        observation = np.array(((1.0, 0.0),))
        uncertainty = observation @ self.covariance @ observation.T + std**2
        gain = self.covariance @ observation.T @ np.linalg.inv(uncertainty)
        self.state = self.state + gain @ (value - observation @ self.state)
        self.covariance = (np.eye(2) - gain @ observation) @ self.covariance


def size_of(position: Array) -> float:
    return float(max(position[0, 2:].mean(), 1.0))


@settings(deadline=None, max_examples=60)
@given(box=boxes, score=scores, steps=st.lists(st.tuples(seconds, boxes, scores), max_size=6))
def test_the_elementwise_filter_is_the_one_with_matrices(
    box: Array, score: Array, steps: list[tuple[float, Array, Array]]
) -> None:
    motion = started(box, score)
    start = xyxy_to_cxcywh(box)
    std = float(measurement_std(start, score, SAME_ERROR_S)[0, 0])
    filters = [
        TextbookFilter.started(start[0, c], std, START_SPEED_STD[c] * size_of(start)) for c in COORDINATES
    ]
    for step_s, seen, seen_score in steps:
        for c in COORDINATES:
            filters[c].predict(step_s, size_of(motion.position), c)
        motion = motion.predicted(step_s)
        for c in (2, 3):
            filters[c].state[0] = max(filters[c].state[0], 0.0)
        measured = xyxy_to_cxcywh(seen)
        motion = motion.corrected(seen, seen_score, step_s)
        for c in COORDINATES:
            filters[c].correct(measured[0, c], float(measurement_std(measured, seen_score, step_s)[0, 0]))
    for c in COORDINATES:
        scale = 1e-9 * max(1.0, float(np.abs(filters[c].covariance).max()))
        np.testing.assert_allclose(motion.estimates[0, :, c], filters[c].state, rtol=1e-7, atol=1e-6)
        expected = filters[c].covariance[(0, 0, 1), (0, 1, 1)]
        np.testing.assert_allclose(motion.variances[0, :, c], expected, rtol=1e-6, atol=scale)


def test_a_box_that_shrinks_becomes_empty_and_not_inverted() -> None:
    motion = started(np.array([[0.0, 0.0, 100.0, 100.0]]), SURE)
    for side in (80.0, 60.0, 40.0):
        motion = motion.predicted(0.1).corrected(np.array([[0.0, 0.0, side, side]]), SURE, 0.1)
    x1, y1, x2, y2 = motion.predicted(5.0).boxes_xyxy[0]
    assert (x1, y1) == (x2, y2)


@pytest.mark.parametrize("side", [0.0, 1e-30, 1e38], ids=["empty", "tiny", "huge"])
@pytest.mark.parametrize("step_s", [1e-9, 60.0], ids=["short", "long"])
@pytest.mark.parametrize("score", [np.zeros(1), np.ones(1)], ids=["doubted", "sure"])
def test_estimates_stay_finite(side: float, step_s: float, score: Array) -> None:
    box = np.array([[-side, -side, side, side]], np.float32)
    motion = started(box, score)
    for _ in range(50):
        motion = motion.predicted(step_s).corrected(box, score, step_s)
    assert all(np.isfinite(values).all() for values in vars(motion).values())
    assert (motion.variances[:, 0] > 0).all()
    assert (motion.variances[:, 2] >= 0).all()


def test_a_camera_that_turns_turns_places_and_velocities() -> None:
    quarter = np.array(((0.0, -2, 30), (2, 0, 40)))  # and doubles all sizes
    motion = started(np.array([[0.0, 0.0, 10.0, 20.0]]), SURE).predicted(0.1)
    motion = motion.corrected(np.array([[2.0, 0.0, 12.0, 20.0]]), SURE, 0.1)
    seen = motion.seen_from(quarter)
    x, y, width, height = motion.position[0]
    np.testing.assert_allclose(seen.position[0], (-2 * y + 30, 2 * x + 40, 2 * width, 2 * height))
    speed_x, speed_y, growth_x, growth_y = motion.estimates[0, 1]
    np.testing.assert_allclose(seen.estimates[0, 1], (-2 * speed_y, 2 * speed_x, 2 * growth_x, 2 * growth_y))
    np.testing.assert_allclose(seen.variances[0, 0, :2], 4 * motion.variances[0, 0, 1::-1])
