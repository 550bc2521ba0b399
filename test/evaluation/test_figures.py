"""Figures of random images: those of pycocotools, of slow definitions, and of the images that were drawn."""

from __future__ import annotations

import contextlib
import io
from argparse import ArgumentTypeError
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.evaluation import figures
from yolov5_lifecycle.evaluation.figures import (
    METRICS,
    MIN_IMAGES,
    RESAMPLES,
    Counts,
    Interval,
    confusion_matrix,
    counts_at,
    differences,
    drawn_weights,
    interval,
    mean_of_classes,
    resampled,
    rows,
    sweep,
)
from yolov5_lifecycle.evaluation.ground_truth import Boxes, DataError
from yolov5_lifecycle.evaluation.matching import (
    MAX_DETECTIONS,
    MIN_CONFIDENCE,
    EvaluatedClasses,
    EvaluatedImage,
    Matches,
    found_annotations,
    match,
    truth_dataset,
)
from yolov5_lifecycle.evaluation.thresholds import Goal, chosen_thresholds, threshold_yaml
from yolov5_lifecycle.settings.parameter_file import read_parameter_file

CLASS_NAMES = ("cat", "dog", "bird")
THRESHOLDS = np.array((0.2, 0.4, 0.6))


def random_images(
    seed: int, count: int, *, classes: int = len(CLASS_NAMES), crowds: float = 0.0, noise: float = 12.0
) -> list[EvaluatedImage]:
    """`count` images with 0 to 6 objects; a share `crowds` of these surrounds many."""
    rng = np.random.default_rng(seed)
    return [_random_image(rng, number, classes, crowds, noise) for number in range(count)]


def _random_image(
    rng: np.random.Generator, number: int, classes: int, crowds: float, noise: float
) -> EvaluatedImage:
    objects = int(rng.integers(0, 7))
    corners = rng.uniform(0, 300, (objects, 2))
    xyxy = np.concatenate((corners, corners + rng.uniform(20, 100, (objects, 2))), axis=1)
    class_ids = rng.integers(0, classes, objects)
    truth = Boxes(xyxy, class_ids, rng.random(objects) < crowds)
    copied = rng.integers(0, objects, rng.integers(0, 2 * objects + 1)) if objects else np.zeros(0, np.int64)
    found = np.sort((xyxy[copied] + rng.normal(0, noise, (len(copied), 4))).reshape(-1, 2, 2), axis=1)
    others = rng.integers(0, classes, len(copied))
    found_ids = np.where(rng.random(len(copied)) < 0.75, class_ids[copied], others)
    scores = np.sort(rng.random(len(copied)).astype(np.float32))[::-1]
    detections = Detections(found.reshape(-1, 4).astype(np.float32), scores, found_ids)
    return EvaluatedImage(f"{number}.png", (400, 500), truth, detections)


def slow_ranking(
    images: Sequence[EvaluatedImage], class_id: int, min_iou: float
) -> tuple[list[tuple[float, bool]], int]:
    """Score of each detection of a class, best first, and whether it is right; number of objects.

    Each takes the free object that it overlaps most. Images without crowds alone.
    """
    found = sorted(
        (-float(image.found.scores[row]), number, row)
        for number, image in enumerate(images)
        for row in np.flatnonzero(image.found.class_ids == class_id).tolist()
    )
    free = [set(np.flatnonzero(image.truth.class_ids == class_id).tolist()) for image in images]
    objects, ranked = sum(map(len, free)), []
    for score, number, row in found:
        box = images[number].found.boxes_xyxy[row].astype(np.float64)
        overlaps = [(slow_iou(box, images[number].truth.xyxy[target]), target) for target in free[number]]
        iou, target = max(overlaps, default=(0.0, -1))
        free[number] -= {target} if iou >= min_iou else set()
        ranked.append((-score, iou >= min_iou))
    return ranked, objects


def slow_iou(box: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    x1, y1, x2, y2 = box
    left, top, right, bottom = other
    shared = max(min(x2, right) - max(x1, left), 0) * max(min(y2, bottom) - max(y1, top), 0)
    return float(shared / ((x2 - x1) * (y2 - y1) + (right - left) * (bottom - top) - shared))


@pytest.mark.parametrize("crowds", [0.0, 0.3])
@pytest.mark.parametrize("seed", [0, 1])
def test_average_precision_is_what_pycocotools_prints_with_its_own_defaults(seed: int, crowds: float) -> None:
    images = random_images(seed, 40, crowds=crowds)
    with contextlib.redirect_stdout(io.StringIO()):
        data = COCO()
        data.dataset = truth_dataset(images, CLASS_NAMES)
        data.createIndex()
        evaluation = COCOeval(data, data.loadRes(found_annotations(images)), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    matches = match(images, CLASS_NAMES)
    assert float(mean_of_classes(matches.ap50_95)) == pytest.approx(evaluation.stats[0], rel=1e-14)
    assert float(mean_of_classes(matches.ap50)) == pytest.approx(evaluation.stats[1], rel=1e-14)


def test_without_detections_everything_is_missed_and_without_objects_there_is_no_figure() -> None:
    images = [replace(image, found=image.found[:0]) for image in random_images(3, 5)]
    together, *_, dragon = rows(match(images, (*CLASS_NAMES, "dragon")), np.full(4, 0.25))
    assert together["objects"] == sum(len(image.truth) for image in images) > 0
    assert (together["right"], together["wrong"], together["ap50"]) == (0, 0, 0)
    assert np.isnan([together["precision"], *(dragon[metric] for metric in METRICS)]).all()


DATA = ("dog", "unicorn", "cat", "bird")
FIRST: tuple[Sequence[str], frozenset[int] | None] = (("cat", "dog", "car", "bird"), None)
SECOND: tuple[Sequence[str], frozenset[int] | None] = (("bird", "cat", "dog"), frozenset({1, 2}))
BOX = (1.0, 2.0, 3.0, 4.0)


def found_in_turn(class_ids: Sequence[int]) -> Detections:
    """One box of each of these classes, the best first."""
    count = len(class_ids)
    boxes = np.tile(np.array(BOX, np.float32), (count, 1))
    return Detections(boxes, np.linspace(1, 0.5, count, dtype=np.float32), np.array(class_ids, np.int64))


def test_two_models_are_evaluated_in_the_classes_that_both_know_and_want() -> None:
    classes = EvaluatedClasses.shared(DATA, [FIRST, SECOND])
    assert (classes.names, classes.left_out) == (("dog", "cat"), ("unicorn", "bird"))
    truth = classes.truth(Boxes.of([BOX] * 4, [0, 1, 2, 3]))
    assert [classes.names[class_id] for class_id in truth.class_ids] == ["dog", "cat"]
    for model, (names, _) in enumerate((FIRST, SECOND)):
        found = classes.found(found_in_turn(range(len(names))), model)
        assert [classes.names[one] for one in found.class_ids] == [
            one for one in names if one in classes.names
        ]


def test_only_the_best_detections_of_a_class_count() -> None:
    many = found_in_turn([0, 1] * (MAX_DETECTIONS + 5))
    kept = EvaluatedClasses.shared(None, [(("cat", "dog"), None)]).found(many, 0)
    np.testing.assert_array_equal(kept.scores, many.scores[: 2 * MAX_DETECTIONS])


def test_without_names_the_ids_are_those_of_the_model() -> None:
    classes = EvaluatedClasses.shared(None, [FIRST])
    assert classes.names == FIRST[0]
    with pytest.raises(DataError, match="expected a class from 0 to 3, found 4"):
        classes.truth(Boxes.of([BOX], [4]))
    assert len(classes.truth(Boxes.of([], []))) == 0


@pytest.mark.parametrize(
    ("names", "told"),
    [
        pytest.param(("Dog",), "Did you mean 'dog'?", id="other spelling"),
        pytest.param((), "The data set has the classes (none)", id="no names"),
        pytest.param(tuple(f"class {number}" for number in range(20)), "class 9, ...", id="many names"),
    ],
)
def test_nothing_in_common_is_refused_with_both_lists(names: tuple[str, ...], told: str) -> None:
    with pytest.raises(DataError) as refused:
        EvaluatedClasses.shared(names, [FIRST])
    assert told in str(refused.value)
    assert "cat, dog, car, bird" in str(refused.value)


def numbers(counts: Counts, place: int) -> tuple[int, int, int]:
    """Right, wrong, objects."""
    return int(counts.right[place]), int(counts.wrong[place]), int(counts.objects.flat[place])


def at_one(matches: Matches, threshold: float) -> Counts:
    """Counts (1 + classes,) with one threshold for all classes."""
    counts = counts_at(matches, np.full(len(matches.class_names), threshold))
    return Counts(counts.right[0], counts.wrong[0], counts.objects[0])


@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
def test_counts_are_those_of_the_detections_above_the_threshold(threshold: float) -> None:
    images = random_images(7, 20)
    matches = match(images, CLASS_NAMES)
    found = at_one(matches, threshold)
    for class_id in range(len(CLASS_NAMES)):
        ranked, objects = slow_ranking(images, class_id, 0.5)
        above = [is_right for score, is_right in ranked if score > threshold]
        expected = sum(above), len(above) - sum(above), objects
        assert numbers(found, 1 + class_id) == expected
        scores, counts = sweep(matches, class_id)
        last = int((scores > threshold).sum()) - 1
        of_sweep = (int(counts.right[last]), int(counts.wrong[last])) if last >= 0 else (0, 0)
        assert (*of_sweep, int(counts.objects)) == expected


def test_all_classes_together_have_the_counts_of_each_and_the_mean_precision_of_those_with_objects() -> None:
    names = (*CLASS_NAMES, "dragon")
    together, *each = rows(match(random_images(7, 20), names), np.array((0.2, 0.5, 0.8, 0.5)))
    for name in ("right", "wrong", "objects"):
        assert together[name] == sum(row[name] for row in each)
    assert together["ap50"] == pytest.approx(np.mean([row["ap50"] for row in each[:3]]))
    assert max(row["images"] for row in each) <= together["images"] <= 20
    assert np.isnan(mean_of_classes(np.array((np.nan, np.nan))))


def test_a_detection_in_a_crowd_is_neither_right_nor_wrong() -> None:
    images = random_images(11, 30, crowds=1.0)
    matches = match(images, CLASS_NAMES)
    _, counts = sweep(matches)
    assert counts.objects == 0
    assert 0 == counts.right[-1] < counts.wrong[-1] < sum(len(image.found) for image in images)
    assert confusion_matrix(images, matches, np.zeros(3))[:-1].sum() == 0


@pytest.mark.parametrize("crowds", [0.0, 0.2])
@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
def test_the_confusion_matrix_has_each_object_and_detection_once(threshold: float, crowds: float) -> None:
    images = random_images(5, 30, crowds=crowds)
    matches = match(images, CLASS_NAMES)
    counts = confusion_matrix(images, matches, np.full(3, threshold))
    _, *each = rows(matches, np.full(3, threshold))
    assert np.diagonal(counts).tolist() == [*(row["right"] for row in each), 0]
    assert counts[:-1].sum(axis=1).tolist() == [row["objects"] for row in each]
    assert counts[:, :-1].sum(axis=0).tolist() == [row["right"] + row["wrong"] for row in each]


def test_an_object_that_another_class_was_found_on_is_confused_with_it() -> None:
    image = next(image for image in random_images(5, 30, noise=0) if len(image.truth) == 6)
    found = image.found[:1]
    target = int(np.abs(image.truth.xyxy - found.boxes_xyxy[0]).sum(axis=1).argmin())
    true = int(image.truth.class_ids[target])
    other = (true + 1) % 3
    changed = replace(image, found=replace(found, class_ids=np.array([other], np.int64)))
    counts = confusion_matrix([changed], match([changed], CLASS_NAMES), np.zeros(3))
    assert (counts[true, other], counts[:-1, -1].sum(), counts[-1].sum()) == (1, 5, 0)


@pytest.mark.parametrize(
    ("text", "goal"),
    [("f1", Goal("f1")), ("recall=0.9", Goal("recall", 0.9)), ("precision=1", Goal("precision", 1.0))],
)
def test_a_goal_is_understood(text: str, goal: Goal) -> None:
    assert Goal.parsed(text) == goal


@pytest.mark.parametrize("text", ["", "f2", "recall=", "recall=0.0", "precision=1.1", "f1=0.9", "recall=nan"])
def test_another_goal_is_refused(text: str) -> None:
    with pytest.raises(ArgumentTypeError, match="expected f1, recall"):
        Goal.parsed(text)


@pytest.mark.parametrize("goal", ["f1", "recall=0.5", "precision=0.7"])
def test_a_threshold_gives_the_reported_counts_and_none_is_better(goal: str) -> None:
    wanted = Goal.parsed(goal)
    matches = match(random_images(2, 60, noise=6), CLASS_NAMES)
    tried = [at_one(matches, value) for value in np.linspace(0, 1, 200)]
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
    goal, names = Goal("recall", 1.0), (*CLASS_NAMES, "unicorn")
    text = threshold_yaml(chosen_thresholds(match(random_images(2, 60), names), goal), goal, "/yolov5")
    assert '# "cat": out of reach, the closest is precision 0.' in text
    assert text.endswith("# Classes without objects, and so without a threshold: 1.\n")
    (tmp_path / "thresholds.yaml").write_text(text)
    assert read_parameter_file(tmp_path / "thresholds.yaml") == {}


@pytest.mark.parametrize("crowds", [0.0, 0.3])
def test_a_resample_has_the_figures_of_the_images_that_were_drawn(
    crowds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "MAX_ELEMENTS", 100)  # several portions
    images = random_images(0, 15, crowds=crowds)
    weights = drawn_weights(len(images), 8)
    samples = resampled(match(images, CLASS_NAMES), THRESHOLDS, weights)
    for draw, of_draw in enumerate(weights.tolist()):
        drawn = [image for image, count in zip(images, of_draw, strict=True) for _ in range(count)]
        for number, row in enumerate(rows(match(drawn, CLASS_NAMES), THRESHOLDS)):
            for metric in METRICS:
                found = samples[metric][draw, number]
                assert found == pytest.approx(row[metric], abs=1e-9, nan_ok=True), (metric, number)


def test_the_draws_are_the_same_in_every_run() -> None:
    weights = drawn_weights(30)
    assert weights.shape == (RESAMPLES, 30)
    assert (weights.sum(axis=1) == 30).all()
    np.testing.assert_array_equal(weights, drawn_weights(30))


def compared(first: list[EvaluatedImage], second: list[EvaluatedImage]) -> list[dict[str, Interval]]:
    return differences([match(images, CLASS_NAMES) for images in (first, second)], [THRESHOLDS, THRESHOLDS])


def without_detections_from(images: list[EvaluatedImage], first: int) -> list[EvaluatedImage]:
    """The images, those from number `first` on without detections."""
    return [*images[:first], *(replace(image, found=image.found[:0]) for image in images[first:])]


def test_a_model_that_finds_less_is_worse_and_the_other_better() -> None:
    images = random_images(6, 60, noise=3)
    less = without_detections_from(images, 30)
    worse, better = compared(images, less)[0], compared(less, images)[0]
    for metric in ("recall", "f1", "ap50", "ap50_95"):
        assert (worse[metric].verdict, better[metric].verdict) == ("worse", "better")


def test_nothing_is_concluded_from_equal_models_from_few_images_and_without_objects() -> None:
    images = random_images(6, 20, classes=2)
    all_classes, *_, bird = compared(images, images)
    assert {found.verdict for found in all_classes.values()} == {"no difference shown"}
    assert {found.verdict for found in bird.values()} == {None}
    few = random_images(6, MIN_IMAGES - 1)
    verdicts = {found.verdict for found in compared(few, without_detections_from(few, 1))[0].values()}
    assert verdicts == {"too few images"}


def test_an_interval_holds_the_difference_in_most_data_sets() -> None:
    """Many small data sets of two models whose true difference is known from a large one."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(200):
        first = rng.random(40) < 0.6
        second = np.where(rng.random(40) < 0.5, first, rng.random(40) < 0.8)  # in truth 0.1 more
        weights = drawn_weights(40, 300)
        samples = ((weights @ first) / 40, (weights @ second) / 40)
        found = interval(samples, (float(first.mean()), float(second.mean())), 40)
        held += found.difference_low <= 0.1 <= found.difference_high
    assert 0.88 <= held / 200 <= 0.99
