"""Thresholds of classes in every runtime, which must find what they admit and nothing else."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY
from support.runtime_names import EVERY_RUNTIME

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.loaded_detector import load_detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.sources.scene import CLASS_NAMES

CIRCLE, SQUARE = (CLASS_NAMES.index(name) for name in ("circle", "square"))
LOW = 0.002
"""Faint traces of circles score above it, and below what is looked for otherwise."""
SELECTIONS = [
    pytest.param(Selection(confidence_threshold=0.9, class_thresholds=((CIRCLE, LOW),)), id="one-low"),
    pytest.param(Selection(confidence_threshold=LOW, class_thresholds=((CIRCLE, 0.9),)), id="one-high"),
    pytest.param(Selection(class_thresholds=((CIRCLE, LOW), (SQUARE, 0.92))), id="two"),
    pytest.param(
        Selection(class_thresholds=((CIRCLE, LOW),), classes=frozenset({CIRCLE}), max_detections=2), id="only"
    ),
]


@pytest.fixture(scope="module")
def image() -> ColourImage:
    pixels: NDArray[np.uint8] = np.asarray(cv2.imread(str(REPOSITORY / "docs" / "images" / "shapes.jpg")))
    return ColourImage(pixels, "bgr")


@pytest.fixture(scope="module")
def model() -> Model:
    return load_weights(REPOSITORY / "weights" / "shapes.safetensors").model


@pytest.fixture(params=EVERY_RUNTIME, scope="module")
def detector(model: Model, request: pytest.FixtureRequest) -> Iterator[Detector]:
    detector = load_detector(model, device="cpu", runtime=request.param)
    yield detector
    detector.close()


@pytest.fixture(scope="module")
def everything(detector: Detector, image: ColourImage) -> Detections:
    """Every class, down to the lowest threshold of this file; NMS of one class ignores the others."""
    return detector.detect(image, Selection(confidence_threshold=LOW, max_detections=30_000))


@pytest.mark.long
@pytest.mark.parametrize("selection", SELECTIONS)
def test_each_class_is_found_down_to_its_own_threshold(
    selection: Selection, detector: Detector, everything: Detections, image: ColourImage
) -> None:
    found = detector.detect(image, selection)
    wanted = selection.admits(everything.scores, everything.class_ids)
    if selection.classes is not None:
        wanted &= np.isin(everything.class_ids, list(selection.classes))
    rows = np.flatnonzero(wanted)[: selection.max_detections]
    np.testing.assert_array_equal(found.class_ids, everything.class_ids[rows])
    np.testing.assert_allclose(found.scores, everything.scores[rows], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.boxes_xyxy, everything.boxes_xyxy[rows], rtol=0, atol=1e-2)
