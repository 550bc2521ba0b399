"""Average precision: that of pycocotools as anyone else would use it, and of a slow reference."""

from __future__ import annotations

import contextlib
import io
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from support.random_evaluation import CLASS_NAMES, random_images
from support.slow_precision import IOUS, average_precision

from yolov5_lifecycle.evaluation.evaluated import EvaluatedImage
from yolov5_lifecycle.evaluation.figures import rows
from yolov5_lifecycle.evaluation.matching import (
    MAX_DETECTIONS,
    found_annotations,
    match,
    mean_of_classes,
    truth_dataset,
)


def stats_of_coco(truth: dict[str, Any], found: list[dict[str, Any]]) -> list[float]:
    """What pycocotools prints with its own defaults."""
    with contextlib.redirect_stdout(io.StringIO()):
        data = COCO()
        data.dataset = truth
        data.createIndex()
        evaluation = COCOeval(data, data.loadRes(found), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return [float(value) for value in evaluation.stats]


@pytest.mark.parametrize("crowds", [0.0, 0.3])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_average_precision_is_that_of_pycocotools(seed: int, crowds: float) -> None:
    images = random_images(seed, 40, crowds=crowds)
    matches = match(images, CLASS_NAMES)
    stats = stats_of_coco(truth_dataset(images, CLASS_NAMES), found_annotations(images))
    assert mean_of_classes(matches.ap50_95) == pytest.approx(stats[0], abs=1e-6)
    assert mean_of_classes(matches.ap50) == pytest.approx(stats[1], abs=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_average_precision_is_that_of_its_definition(seed: int) -> None:
    images = random_images(seed, 8)
    matches = match(images, CLASS_NAMES)
    slow = np.array([[average_precision(images, class_id, least) for least in IOUS] for class_id in range(3)])
    np.testing.assert_allclose(matches.ap50, slow[:, 0], atol=1e-6)
    np.testing.assert_allclose(matches.ap50_95, slow.mean(axis=1), atol=1e-6)


def test_without_any_detection_everything_is_missed() -> None:
    images = [_without_detections(image) for image in random_images(3, 5)]
    matches = match(images, CLASS_NAMES)
    together, *_ = rows(matches, CLASS_NAMES, np.full(3, 0.25))
    assert together.counts.objects == sum(len(image.truth) for image in images) > 0
    assert (together.counts.right, together.counts.wrong, together.ap50) == (0, 0, 0)
    assert np.isnan(together.counts.precision)


def test_without_objects_there_is_no_figure() -> None:
    image = random_images(3, 5)[0]
    matches = match([_without_detections(image)], ("unicorn", *CLASS_NAMES, "dragon"))
    assert np.isnan(matches.ap50[-1])
    assert np.isnan(rows(matches, ("unicorn", *CLASS_NAMES, "dragon"), np.full(5, 0.5))[-1].counts.f1)


def test_only_the_best_detections_of_a_class_count() -> None:
    image = random_images(3, 1)[0]
    many = image.found.__class__(
        np.tile((10.0, 10.0, 20.0, 20.0), (MAX_DETECTIONS + 5, 1)),
        np.linspace(1, 0.5, MAX_DETECTIONS + 5),
        np.zeros(MAX_DETECTIONS + 5, np.int64),
    )
    crowded = EvaluatedImage(image.label, image.size_hw, image.truth, many)
    assert len(found_annotations([crowded])) == MAX_DETECTIONS
    assert len(match([crowded], CLASS_NAMES).classes[0].scores) == MAX_DETECTIONS


def _without_detections(image: EvaluatedImage) -> EvaluatedImage:
    nothing = np.zeros(0)
    found = image.found.__class__(nothing.reshape(0, 4), nothing, nothing.astype(np.int64))
    return EvaluatedImage(image.label, image.size_hw, image.truth, found)
