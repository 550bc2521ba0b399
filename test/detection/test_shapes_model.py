"""The embedded models find circles, squares, triangles and stars, and their pixels, as the node does."""

from __future__ import annotations

import numpy as np
import pytest
from support.colcon_workspace import REPOSITORY

from tools.shapes.evaluate import IMAGES, UNSEEN_SEED, evaluate, moving, stills
from yolov5_lifecycle.checkpoints.locate import WeightsFile, load_weights
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.sources.scene import CLASS_NAMES

WEIGHTS = REPOSITORY / "weights"
SIZES = [
    pytest.param((480, 640), 640, id="640x480 at 640"),
    pytest.param((240, 320), 320, id="320x240 at 320"),
]


@pytest.fixture(scope="module")
def detecting() -> WeightsFile:
    return load_weights(WEIGHTS / "shapes.safetensors")


@pytest.fixture(scope="module")
def segmenting() -> WeightsFile:
    return load_weights(WEIGHTS / "shapes-seg.safetensors")


def detector_of(file: WeightsFile, image_size: int = 320, runtime: str = "auto") -> Detector:
    return load_detector(file.model, device="cpu", image_size=image_size, runtime=runtime)


def test_the_files_are_small_know_the_classes_of_the_scene_and_have_their_model_card(
    detecting: WeightsFile, segmenting: WeightsFile
) -> None:
    for file in (detecting, segmenting):
        assert file.path.stat().st_size < 1_500_000
        assert file.model.class_names == CLASS_NAMES
        assert file.sha256 in (WEIGHTS / "README.md").read_text()
    assert segmenting.model.architecture.mask_coefficients == 32


@pytest.mark.long
def test_unseen_stills_are_detected_with_few_errors(detecting: WeightsFile) -> None:
    result = evaluate(detector_of(detecting), stills(UNSEEN_SEED, IMAGES, (256, 320)))
    assert len(result.scores) + result.missed > 2 * IMAGES
    assert set(result.class_ids) == set(range(len(CLASS_NAMES)))
    assert result.precision >= 0.95
    assert result.recall >= 0.95


@pytest.mark.long
@pytest.mark.parametrize(("size_hw", "image_size"), SIZES)
def test_moving_shapes_are_found_where_they_are(
    detecting: WeightsFile, size_hw: tuple[int, int], image_size: int
) -> None:
    result = evaluate(detector_of(detecting, image_size), moving(UNSEEN_SEED, 100, size_hw))
    circles = result.scores[result.class_ids == CLASS_NAMES.index("circle")]
    assert result.recall >= 0.97
    assert result.precision >= 0.93
    assert (circles > 0.6).mean() >= 0.95


@pytest.mark.long
@pytest.mark.parametrize(("size_hw", "image_size"), SIZES)
def test_masks_of_moving_shapes_cover_them(
    segmenting: WeightsFile, size_hw: tuple[int, int], image_size: int
) -> None:
    result = evaluate(detector_of(segmenting, image_size), moving(UNSEEN_SEED, 60, size_hw))
    assert set(result.class_ids) == set(range(len(CLASS_NAMES)))
    assert len(result.mask_ious) == len(result.scores)
    assert result.mask_ious.mean() >= 0.85


def test_an_empty_image_has_no_shapes(detecting: WeightsFile) -> None:
    detector = detector_of(detecting, runtime="torch")
    for level in (0, 114, 255):
        empty = ColourImage(np.full((480, 640, 3), level, np.uint8), "rgb")
        assert len(detector.detect(empty, Selection())) == 0
