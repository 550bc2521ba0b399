"""The drive of `make bench` on which collected images are compared with all others."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from benchmark.collected_errors import (
    FRAMES_IN_A_PLACE,
    FRAMES_OF_A_TURN,
    PLACES,
    SIZE_HW,
    USUAL,
    Outcome,
    drive,
    errors,
    figures,
)
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.sources.scene import Truth

pytestmark = pytest.mark.long

BOXES = np.array([[0, 0, 10, 10], [20, 20, 40, 40]], np.float32)
TRUTH = Truth(BOXES, np.array([0, 1], np.int64))
WEAK = {"blur", "night", "small", "new look"}


def found(boxes: np.ndarray, *class_ids: int) -> Detections:
    scores = np.full(len(boxes), 0.9, np.float32)
    return Detections(np.asarray(boxes, np.float32), scores, np.array(class_ids, np.int64))


@pytest.mark.parametrize(
    ("detections", "expected"),
    [
        pytest.param(found(BOXES, 0, 1), 0, id="all"),
        pytest.param(found(BOXES[::-1], 1, 0), 0, id="in another order"),
        pytest.param(found(BOXES[:1], 0), 1, id="one missed"),
        pytest.param(found(BOXES[:0]), 2, id="none found"),
        pytest.param(found(BOXES, 0, 0), 2, id="another class"),
        pytest.param(found(BOXES + 100, 0, 1), 4, id="elsewhere"),
        pytest.param(found(BOXES[[0, 1, 1]], 0, 1, 1), 1, id="one twice"),
    ],
)
def test_errors_are_missed_false_and_confused_objects(detections: Detections, expected: int) -> None:
    assert errors(detections, TRUTH) == expected


def test_a_drive_shows_every_weakness_and_its_truth_is_in_the_image() -> None:
    frames = list(itertools.islice(drive(0), 12 * (FRAMES_IN_A_PLACE + FRAMES_OF_A_TURN)))
    assert [frame.number for frame in frames] == list(range(len(frames)))
    assert {frame.weakness for frame in frames} >= {USUAL}
    for frame in frames:
        assert frame.pixels.shape == (*SIZE_HW, 3)
        assert (frame.truth.boxes_xyxy >= 0).all()
        assert (frame.truth.boxes_xyxy[:, 2:] <= SIZE_HW[::-1]).all()
    shows_objects = {len(frame.truth.class_ids) > 0 for frame in frames}
    assert shows_objects == {True, False}


def test_a_fifth_of_the_places_are_difficult() -> None:
    kinds = {frame.place: frame.weakness for frame in drive(3)}
    assert len(kinds) == PLACES
    assert sum(kind != USUAL for kind in kinds.values()) == PLACES // 5
    assert {*kinds.values()} == {USUAL, *WEAK}


def test_the_figures_compare_kept_images_with_all() -> None:
    moved = Truth(BOXES + np.array([5, 0, 5, 0], np.float32), TRUTH.class_ids)
    outcome = Outcome(
        errors=[0, 0, 4, 4],
        weaknesses=[USUAL, USUAL, "blur", "night"],
        places=[0, 0, 1, 1],
        truths=[TRUTH, moved, TRUTH, TRUTH],
        kept=[2, 3],
    )
    assert outcome.density_ratio == 2.0
    assert outcome.duplicates == 0.5  # the last shows what the one before shows
    assert replace(outcome, kept=[0, 1]).duplicates == 0
    _, goals = figures([outcome])
    assert [goal.value for goal in goals] == [2.0, 50.0, 2]
    assert not any(goal.is_reached for goal in goals)
