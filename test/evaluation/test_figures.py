"""Counts at thresholds, the confusion matrix, and the thresholds that reach a goal."""

from __future__ import annotations

from argparse import ArgumentTypeError
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.random_evaluation import CLASS_NAMES, random_images
from support.slow_precision import iou

from yolov5_lifecycle.evaluation.figures import (
    MIN_IOU,
    Counts,
    confusion_matrix,
    counts_at,
    mean_of_classes,
    rows,
    sweep,
)
from yolov5_lifecycle.evaluation.matching import MIN_CONFIDENCE, EvaluatedImage, Matches, match
from yolov5_lifecycle.evaluation.thresholds import Goal, chosen_thresholds, threshold_yaml
from yolov5_lifecycle.settings.parameter_file import read_parameter_file

THRESHOLDS = (0.0, 0.1, 0.5, 0.9, 1.0)


def slow_counts(images: list[EvaluatedImage], class_id: int, threshold: float) -> tuple[int, int, int]:
    """Right, wrong, objects; each detection, best first, takes the free object that it overlaps most."""
    right = wrong = objects = 0
    for image in images:
        free = set(np.flatnonzero(image.truth.class_ids == class_id).tolist())
        objects += len(free)
        for row in np.flatnonzero(image.found.class_ids == class_id).tolist():
            if image.found.scores[row] <= threshold:
                continue
            box = image.found.boxes_xyxy[row].astype(np.float64)
            best = max(((iou(box, image.truth.xyxy[target]), target) for target in free), default=(0.0, -1))
            free.discard(best[1] if best[0] >= MIN_IOU else -1)
            right += best[0] >= MIN_IOU
            wrong += best[0] < MIN_IOU
    return right, wrong, objects


def numbers(counts: Counts, place: int) -> tuple[int, int, int]:
    """Right, wrong, objects."""
    return int(counts.right[place]), int(counts.wrong[place]), int(counts.objects.flat[place])


def at_one(matches: Matches, threshold: float) -> Counts:
    """Counts (1 + classes,) with one threshold for all classes."""
    counts = counts_at(matches, np.full(len(matches.class_names), threshold))
    return Counts(counts.right[0], counts.wrong[0], counts.objects[0])


@pytest.mark.parametrize("threshold", THRESHOLDS)
def test_counts_are_those_of_the_detections_above_the_threshold(threshold: float) -> None:
    images = random_images(7, 20)
    matches = match(images, CLASS_NAMES)
    found = at_one(matches, threshold)
    for class_id in range(len(CLASS_NAMES)):
        expected = slow_counts(images, class_id, threshold)
        assert numbers(found, 1 + class_id) == expected
        scores, counts = sweep(matches, class_id)
        above = int((scores > threshold).sum())
        of_sweep = (int(counts.right[above - 1]), int(counts.wrong[above - 1])) if above else (0, 0)
        assert (*of_sweep, int(counts.objects)) == expected


def test_all_classes_together_have_the_counts_of_each() -> None:
    together, *each = rows(match(random_images(7, 20), CLASS_NAMES), np.array((0.2, 0.5, 0.8)))
    for name in ("right", "wrong", "objects"):
        assert getattr(together, name) == sum(getattr(row, name) for row in each)
    assert together.figures["ap50"] == pytest.approx(np.mean([row.figures["ap50"] for row in each]))
    assert max(row.images for row in each) <= together.images <= 20


def test_the_mean_of_classes_is_of_those_with_objects() -> None:
    assert float(mean_of_classes(np.array((0.5, np.nan, 1.0)))) == 0.75
    assert np.isnan(mean_of_classes(np.array((np.nan, np.nan))))


def test_a_detection_in_a_crowd_is_neither_right_nor_wrong() -> None:
    images = random_images(11, 30, crowds=1.0)
    matches = match(images, CLASS_NAMES)
    _, counts = sweep(matches)
    assert counts.objects == 0
    assert 0 == counts.right[-1] < counts.wrong[-1] < sum(len(image.found) for image in images)
    assert confusion_matrix(images, matches, np.zeros(3))[:-1].sum() == 0


@pytest.mark.parametrize("crowds", [0.0, 0.2])
@pytest.mark.parametrize("threshold", THRESHOLDS)
def test_the_confusion_matrix_has_each_object_and_detection_once(threshold: float, crowds: float) -> None:
    images = random_images(5, 30, crowds=crowds)
    matches = match(images, CLASS_NAMES)
    counts = confusion_matrix(images, matches, np.full(3, threshold))
    _, *each = rows(matches, np.full(3, threshold))
    assert np.diagonal(counts).tolist() == [*(row.right for row in each), 0]
    assert counts[:-1].sum(axis=1).tolist() == [row.objects for row in each]
    assert counts[:, :-1].sum(axis=0).tolist() == [row.right + row.wrong for row in each]


def test_an_object_that_another_class_was_found_on_is_confused_with_it() -> None:
    (image,) = [image for image in random_images(5, 30, noise=0) if len(image.truth) == 6][:1]
    found = image.found[np.arange(len(image.found)) < 1]
    truth = int(np.abs(image.truth.xyxy - found.boxes_xyxy[0]).sum(axis=1).argmin())
    other = (int(image.truth.class_ids[truth]) + 1) % 3
    changed = replace(image, found=replace(found, class_ids=np.array([other], np.int64)))
    counts = confusion_matrix([changed], match([changed], CLASS_NAMES), np.zeros(3))
    assert counts[image.truth.class_ids[truth], other] == 1
    assert (counts[:-1, -1].sum(), counts[-1].sum()) == (5, 0)


@pytest.mark.parametrize(
    ("text", "goal"),
    [("f1", Goal("f1")), ("recall=0.9", Goal("recall", 0.9)), ("precision=1", Goal("precision", 1.0))],
)
def test_a_goal_is_understood(text: str, goal: Goal) -> None:
    assert Goal.parsed(text) == goal


@pytest.mark.parametrize(
    "text", ["", "f2", "recall", "recall=", "recall=0.0", "precision=1.1", "f1=0.9", "recall=nan"]
)
def test_another_goal_is_refused(text: str) -> None:
    with pytest.raises(ArgumentTypeError, match="expected f1, recall"):
        Goal.parsed(text)


@pytest.mark.parametrize("goal", ["f1", "recall=0.5", "precision=0.7"], ids=str)
def test_a_threshold_gives_the_reported_counts_and_none_is_better(goal: str) -> None:
    wanted = Goal.parsed(goal)
    matches = match(random_images(2, 60, noise=6), CLASS_NAMES)
    tried = [at_one(matches, value) for value in np.linspace(0, 1, 500)]
    for place, chosen in enumerate(chosen_thresholds(matches, wanted)[1:], start=1):
        assert chosen.value is not None
        right, wrong, _ = numbers(at_one(matches, chosen.value), place)
        assert (right, wrong) == (int(chosen.counts.right), int(chosen.counts.wrong))
        figures = np.array([getattr(counts, wanted.kind)[place] for counts in tried])
        others = [numbers(counts, place) for counts in np.array(tried)[figures >= wanted.least]]
        if wanted.kind == "f1":
            assert chosen.figures["f1"] >= figures.max() - 1e-12
        elif wanted.kind == "recall":
            assert right + wrong <= min(more_right + more_wrong for more_right, more_wrong, _ in others)
        else:
            assert right >= max(fewer_right for fewer_right, *_ in others)


def test_a_threshold_admits_no_detection_that_was_not_evaluated() -> None:
    images = [
        replace(image, found=replace(image.found, scores=(0.002 + 0.006 * image.found.scores)))
        for image in random_images(2, 20)
    ]
    for chosen in chosen_thresholds(match(images, CLASS_NAMES), Goal("precision", 1e-9)):
        assert chosen.value is not None
        assert MIN_CONFIDENCE <= chosen.value < 0.008


def test_thresholds_are_parameters_of_the_node(tmp_path: Path) -> None:
    chosen = chosen_thresholds(match(random_images(2, 60), ('a "cat"', "dög: # x", "bird\n")), Goal("f1"))
    file = tmp_path / "thresholds.yaml"
    file.write_text(threshold_yaml(chosen, Goal("f1"), "/robot/yolov5"))
    assert read_parameter_file(file) == {
        "/robot/yolov5": {
            "confidence_threshold": pytest.approx(chosen[0].value),
            "class_thresholds": [f"{one.name}: {one.value:.12g}" for one in chosen[1:]],
        }
    }


def test_a_goal_out_of_reach_is_reported_with_what_is_closest(tmp_path: Path) -> None:
    goal = Goal("recall", 1.0)
    text = threshold_yaml(
        chosen_thresholds(match(random_images(2, 60), (*CLASS_NAMES, "unicorn")), goal), goal, "/yolov5"
    )
    assert '# "cat": out of reach, the closest is precision 0.' in text
    assert text.endswith("# Classes without objects, and so without a threshold: 1.\n")
    file = tmp_path / "thresholds.yaml"
    file.write_text(text)
    assert read_parameter_file(file) == {}
