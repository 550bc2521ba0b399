"""The embedded segmentation model detects what the detection model does, with the right masks."""

from __future__ import annotations

import numpy as np
import pytest
from support.colcon_workspace import REPOSITORY

from tools.shapes.evaluate import UNSEEN_SEED, evaluate, moving
from yolov5_lifecycle.checkpoints.locate import WeightsFile, load_weights
from yolov5_lifecycle.detection.loaded_detector import load_detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene

WEIGHTS = REPOSITORY / "weights"
PATH = WEIGHTS / "shapes-seg.safetensors"
MIN_IOU = 0.85


@pytest.fixture(scope="module")
def weights_file() -> WeightsFile:
    return load_weights(PATH)


@pytest.fixture(scope="module")
def detecting() -> Model:
    return load_weights(WEIGHTS / "shapes.safetensors").model


def test_the_file_is_small_and_knows_the_classes_of_the_scene(weights_file: WeightsFile) -> None:
    assert PATH.stat().st_size < 1_500_000
    assert weights_file.model.class_names == CLASS_NAMES
    assert weights_file.model.architecture.mask_coefficients == 32


def test_the_model_card_describes_this_file(weights_file: WeightsFile) -> None:
    assert weights_file.sha256 in (WEIGHTS / "README.md").read_text()


@pytest.mark.long
@pytest.mark.parametrize(
    ("size_hw", "image_size"),
    [
        pytest.param((480, 640), 640, id="640x480 at 640", marks=pytest.mark.long),
        pytest.param((240, 320), 320, id="320x240 at 320"),
    ],
)
def test_masks_of_moving_shapes_cover_them(
    weights_file: WeightsFile, size_hw: tuple[int, int], image_size: int
) -> None:
    detector = load_detector(weights_file.model, device="cpu", image_size=image_size)
    result = evaluate(detector, moving(UNSEEN_SEED, 60, size_hw))
    assert set(result.class_ids) == set(range(len(CLASS_NAMES)))
    assert result.mask_ious.mean() >= MIN_IOU


@pytest.mark.long
@pytest.mark.parametrize("image_size", [320, 640])
def test_the_detections_are_those_of_the_model_that_does_not_segment(
    weights_file: WeightsFile, detecting: Model, image_size: int
) -> None:
    detectors = [
        load_detector(model, device="cpu", runtime="torch", image_size=image_size)
        for model in (weights_file.model, detecting)
    ]
    for seed in range(3):
        pixels, _ = Scene(UNSEEN_SEED + seed, (480, 640)).frame(0)
        segmented, detected = (
            detector.detect(ColourImage(pixels, "rgb"), Selection()) for detector in detectors
        )
        np.testing.assert_array_equal(segmented.class_ids, detected.class_ids)
        np.testing.assert_allclose(segmented.scores, detected.scores, atol=1e-4)
        np.testing.assert_allclose(segmented.boxes_xyxy, detected.boxes_xyxy, atol=0.01)
