"""Counts at thresholds, the confusion matrix, and the thresholds that reach a goal."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.random_evaluation import CLASS_NAMES, random_images
from support.slow_precision import iou

from yolov5_lifecycle.evaluation.confusion import MIN_IOU, confusion_matrix
from yolov5_lifecycle.evaluation.evaluated import MIN_CONFIDENCE, EvaluatedImage
from yolov5_lifecycle.evaluation.figures import Counts, counts_at, rows, sweep
from yolov5_lifecycle.evaluation.matching import match
from yolov5_lifecycle.evaluation.thresholds import (
    Goal,
    GoalError,
    chosen_thresholds,
    threshold_yaml,
)
from yolov5_lifecycle.settings.parameter_file import read_parameter_file

THRESHOLDS = (0.0, 0.1, 0.5, 0.9, 1.0)


def slow_counts(images: list[EvaluatedImage], class_id: int, threshold: float) -> Counts:
    """Each detection, best first, takes the free object that it overlaps most."""
    right = wrong = objects = 0
    for image in images:
        free = set(np.flatnonzero(image.truth.class_ids == class_id).tolist())
        objects += len(free)
        for row in np.flatnonzero(image.found.class_ids == class_id).tolist():
            if image.found.scores[row] <= threshold:
                continue
            overlaps = [(iou(image.found.xyxy[row], image.truth.xyxy[target]), target) for target in free]
            best = max(overlaps, default=(0.0, -1))
            free.discard(best[1] if best[0] >= MIN_IOU else -1)
            right += best[0] >= MIN_IOU
            wrong += best[0] < MIN_IOU
    return Counts(right, wrong, objects)


@pytest.mark.parametrize("threshold", THRESHOLDS)
def test_counts_are_those_of_the_detections_above_the_threshold(threshold: float) -> None:
    images = random_images(7, 20)
    matches = match(images, CLASS_NAMES)
    for class_id, of_class in enumerate(matches.classes):
        expected = slow_counts(images, class_id, threshold)
        assert counts_at(of_class, threshold) == expected
        counts = sweep([of_class])
        at = int(counts.at(np.array([threshold]))[0])
        found = (int(counts.right[at]), int(counts.wrong[at])) if at >= 0 else (0, 0)
        assert found == (expected.right, expected.wrong)


def test_all_classes_together_have_the_counts_of_each() -> None:
    matches = match(random_images(7, 20), CLASS_NAMES)
    together, *each = rows(matches, CLASS_NAMES, np.array((0.2, 0.5, 0.8)))
    assert together.counts == sum((row.counts for row in each), Counts(0, 0, 0))
    assert together.ap50 == pytest.approx(np.mean([row.ap50 for row in each]))
    assert max(row.images for row in each) <= together.images <= 20


def test_a_detection_in_a_crowd_is_neither_right_nor_wrong() -> None:
    images = random_images(11, 30, crowds=1.0)
    matches = match(images, CLASS_NAMES)
    counts = sweep(matches.classes)
    assert counts.objects == 0
    assert 0 == counts.right[-1] < counts.wrong[-1] < sum(len(image.found.scores) for image in images)
    assert confusion_matrix(images, matches, np.zeros(3))[:-1].sum() == 0


@pytest.mark.parametrize("crowds", [0.0, 0.2])
@pytest.mark.parametrize("threshold", THRESHOLDS)
def test_the_confusion_matrix_has_each_object_and_detection_once(threshold: float, crowds: float) -> None:
    images = random_images(5, 30, crowds=crowds)
    matches = match(images, CLASS_NAMES)
    counts = confusion_matrix(images, matches, np.full(3, threshold))
    _, *each = rows(matches, CLASS_NAMES, np.full(3, threshold))
    assert np.diagonal(counts).tolist() == [*(row.counts.right for row in each), 0]
    assert counts[:-1].sum(axis=1).tolist() == [row.counts.objects for row in each]
    detected = [row.counts.right + row.counts.wrong for row in each]
    assert counts[:, :-1].sum(axis=0).tolist() == detected


@pytest.mark.parametrize(
    ("text", "goal"),
    [
        pytest.param("f1", Goal("f1"), id="f1"),
        pytest.param("recall=0.9", Goal("recall", 0.9), id="recall"),
        pytest.param("precision=1", Goal("precision", 1.0), id="precision"),
    ],
)
def test_a_goal_is_understood(text: str, goal: Goal) -> None:
    assert Goal.parsed(text) == goal


@pytest.mark.parametrize(
    "text", ["", "f2", "recall", "recall=", "recall=0", "precision=1.1", "f1=0.9", "recall=nan"]
)
def test_another_goal_is_refused(text: str) -> None:
    with pytest.raises(GoalError, match="expected f1, recall"):
        Goal.parsed(text)


@pytest.mark.parametrize("goal", ["f1", "recall=0.5", "precision=0.7"], ids=str)
def test_a_threshold_gives_the_reported_counts_and_none_is_better(goal: str) -> None:
    wanted = Goal.parsed(goal)
    matches = match(random_images(2, 60, noise=6), CLASS_NAMES)
    _, *each = chosen_thresholds(matches, CLASS_NAMES, wanted)
    for chosen, of_class in zip(each, matches.classes, strict=True):
        assert chosen.value is not None
        assert counts_at(of_class, chosen.value) == chosen.counts
        tried = [counts_at(of_class, value) for value in np.linspace(0, 1, 500)]
        if wanted.kind == "f1":
            assert chosen.counts.f1 >= max(counts.f1 for counts in tried) - 1e-12
        elif wanted.kind == "recall":
            others = [counts for counts in tried if counts.recall >= wanted.least]
            assert chosen.counts.right + chosen.counts.wrong <= min(one.right + one.wrong for one in others)
        else:
            others = [counts for counts in tried if counts.precision >= wanted.least]
            assert chosen.counts.recall >= max(one.recall for one in others)


def test_a_threshold_admits_no_detection_that_was_not_evaluated() -> None:
    images = [
        replace(image, found=replace(image.found, scores=0.002 + 0.006 * image.found.scores))
        for image in random_images(2, 20)
    ]
    all_detections = Goal("precision", 1e-9)
    for chosen in chosen_thresholds(match(images, CLASS_NAMES), CLASS_NAMES, all_detections):
        assert chosen.value is not None
        assert MIN_CONFIDENCE <= chosen.value < 0.008


def test_thresholds_are_parameters_of_the_node(tmp_path: Path) -> None:
    matches = match(random_images(2, 60), CLASS_NAMES)
    names = ('a "cat"', "dög: # x", "bird\n")
    chosen = chosen_thresholds(matches, names, Goal("f1"))
    file = tmp_path / "thresholds.yaml"
    file.write_text(threshold_yaml(chosen, Goal("f1"), "/robot/yolov5"))
    assert read_parameter_file(file) == {
        "/robot/yolov5": {
            "confidence_threshold": pytest.approx(chosen[0].value),
            "class_thresholds": [f"{one.name}: {one.value:.12g}" for one in chosen[1:]],
        }
    }


def test_a_goal_out_of_reach_is_reported_with_what_is_closest(tmp_path: Path) -> None:
    matches = match(random_images(2, 60), (*CLASS_NAMES, "unicorn"))
    goal = Goal("recall", 1.0)
    text = threshold_yaml(chosen_thresholds(matches, (*CLASS_NAMES, "unicorn"), goal), goal, "/yolov5")
    assert '# "cat": out of reach, the closest is precision 0.' in text
    assert text.endswith("# Classes without objects, and so without a threshold: 1.\n")
    file = tmp_path / "thresholds.yaml"
    file.write_text(text)
    assert read_parameter_file(file) == {}
