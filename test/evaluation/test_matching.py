"""Average precision: that of pycocotools as anyone else would use it, and of a slow reference."""

from __future__ import annotations

import contextlib
import io
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from support.random_evaluation import CLASS_NAMES, random_images
from support.slow_precision import IOUS, average_precision

from yolov5_lifecycle.evaluation.figures import mean_of_classes, rows
from yolov5_lifecycle.evaluation.matching import found_annotations, match, truth_dataset


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
    assert float(mean_of_classes(matches.ap50_95)) == pytest.approx(stats[0], rel=1e-14)
    assert float(mean_of_classes(matches.ap50)) == pytest.approx(stats[1], rel=1e-14)


@pytest.mark.parametrize("seed", range(6))
def test_average_precision_is_that_of_its_definition(seed: int) -> None:
    images = random_images(seed, 8)
    matches = match(images, CLASS_NAMES)
    slow = np.array([[average_precision(images, class_id, least) for least in IOUS] for class_id in range(3)])
    np.testing.assert_allclose(matches.ap50, slow[:, 0], atol=1e-6)
    np.testing.assert_allclose(matches.ap50_95, slow.mean(axis=1), atol=1e-6)


def test_without_any_detection_everything_is_missed() -> None:
    images = [replace(image, found=image.found[:0]) for image in random_images(3, 5)]
    together, *_ = rows(match(images, CLASS_NAMES), np.full(3, 0.25))
    assert together.objects == sum(len(image.truth) for image in images) > 0
    assert (together.right, together.wrong, together.figures["ap50"]) == (0, 0, 0)
    assert np.isnan(together.figures["precision"])


def test_without_objects_there_is_no_figure() -> None:
    *_, dragon = rows(match(random_images(3, 5), (*CLASS_NAMES, "dragon")), np.full(4, 0.5))
    assert np.isnan(list(dragon.figures.values())).all()
