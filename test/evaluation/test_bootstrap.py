"""Resampled figures are those of the drawn images; verdicts need enough images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.random_evaluation import CLASS_NAMES, random_images

from yolov5_lifecycle.evaluation import bootstrap
from yolov5_lifecycle.evaluation.bootstrap import (
    MIN_IMAGES,
    RESAMPLES,
    differences,
    drawn_weights,
    interval,
    resampled,
)
from yolov5_lifecycle.evaluation.figures import METRICS, rows
from yolov5_lifecycle.evaluation.matching import EvaluatedImage, match

THRESHOLDS = np.array((0.2, 0.4, 0.6))


@pytest.mark.parametrize("crowds", [0.0, 0.3])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_resample_has_the_figures_of_the_images_that_were_drawn(
    seed: int, crowds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bootstrap, "MAX_ELEMENTS", 100)  # several portions
    images = random_images(seed, 15, crowds=crowds)
    weights = drawn_weights(len(images), 8)
    samples = resampled(match(images, CLASS_NAMES), THRESHOLDS, weights)
    for draw, of_draw in enumerate(weights.tolist()):
        drawn = [image for image, count in zip(images, of_draw, strict=True) for _ in range(count)]
        for number, row in enumerate(rows(match(drawn, CLASS_NAMES), THRESHOLDS)):
            for metric in METRICS:
                found = samples[metric][draw, number]
                assert found == pytest.approx(row.figures[metric], abs=1e-9, nan_ok=True), (metric, number)


def test_the_draws_are_the_same_in_every_run() -> None:
    weights = drawn_weights(30)
    assert weights.shape == (RESAMPLES, 30)
    assert (weights.sum(axis=1) == 30).all()
    np.testing.assert_array_equal(weights, drawn_weights(30))


def compared(
    first: list[EvaluatedImage], second: list[EvaluatedImage]
) -> list[dict[str, bootstrap.Interval]]:
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


def test_nothing_is_concluded_from_equal_models_and_from_few_images() -> None:
    images = random_images(6, 60)
    assert {found.verdict for row in compared(images, images) for found in row.values()} == {
        "no difference shown"
    }
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


def test_a_class_without_objects_has_no_verdict() -> None:
    images = random_images(6, 20, classes=2)
    assert {found.verdict for found in compared(images, images)[3].values()} == {None}
