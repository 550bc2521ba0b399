"""The official yolov5n gives the answers that the official pipeline gave."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.nms import Selection, select
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime

CASE_NAMES = ("defaults", "square frame", "small with one class", "low threshold and agnostic")


@pytest.fixture(scope="module")
def model(reference_dir: Path) -> Model:
    return load_weights(reference_dir / "weights" / "yolov5n.pt").model


@pytest.fixture(scope="module")
def runtime(model: Model) -> Iterator[TorchRuntime]:
    runtime = TorchRuntime.load(model, device="cpu", precision="fp32")
    yield runtime
    runtime.close()


@pytest.fixture(scope="module")
def bus(reference_dir: Path) -> ColourImage:
    pixels = cv2.imread(str(reference_dir / "images" / "bus.jpg"))
    assert pixels is not None
    return ColourImage(pixels, "bgr")


@pytest.fixture(scope="module")
def golden(reference_dir: Path) -> Any:
    return json.loads((reference_dir / "golden" / "yolov5n_bus.json").read_text())


@pytest.fixture(params=CASE_NAMES)
def case(request: pytest.FixtureRequest, golden: Any) -> Any:
    return golden["cases"][CASE_NAMES.index(request.param)]


def letterbox_of(case: Any, bus: ColourImage) -> Letterbox:
    settings = case["settings"]
    stride = 32 if settings["auto"] else settings["imgsz"]  # the only multiple up to itself makes a square
    return Letterbox.fit(bus.size_hw, image_size=settings["imgsz"], stride=stride)


def selection_of(case: Any) -> Selection:
    settings = case["settings"]
    return Selection(
        confidence_threshold=settings["conf"],
        iou_threshold=settings["iou"],
        max_detections=settings["maxdet"],
        classes=None if settings["classes"] is None else frozenset(settings["classes"]),
        agnostic_nms=settings["agn"],
    )


def assert_same(found: Detections, expected_rows: list[list[float]], *, atol_px: float) -> None:
    expected = np.array(expected_rows)  # x1, y1, x2, y2, score, class
    np.testing.assert_array_equal(found.class_ids, expected[:, 5])
    np.testing.assert_allclose(found.scores, expected[:, 4], rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.boxes_xyxy, expected[:, :4], rtol=0, atol=atol_px)


def test_every_official_answer_is_compared(golden: Any) -> None:
    assert len(golden["cases"]) == len(CASE_NAMES)


def test_class_names_are_the_official_ones(model: Model, golden: Any) -> None:
    assert list(model.class_names) == golden["names"]


def test_the_letterboxed_image_is_the_same(case: Any, bus: ColourImage) -> None:
    frame = letterbox_of(case, bus).apply(bus.pixels)
    assert [1, 3, *frame.shape[:2]] == case["network_input_shape"]
    assert frame.sum(dtype=np.int64) == case["letterbox_uint8_sum"]


def test_detections_in_source_pixels_are_the_same(case: Any, bus: ColourImage, runtime: TorchRuntime) -> None:
    letterbox = letterbox_of(case, bus)
    found = select(runtime(letterbox.apply(bus.pixels), bus.order).rows, selection_of(case))
    in_source = Detections(letterbox.undo(found.boxes_xyxy), found.scores, found.class_ids)
    # YOLOv5 pads by whole pixels but maps back with half ones; we map back what was padded.
    assert_same(
        in_source, case["detections_source_px"], atol_px=0.6 * max(bus.size_hw) / case["settings"]["imgsz"]
    )


@pytest.mark.parametrize("case", [name for name in CASE_NAMES if name != "square frame"], indirect=True)
def test_the_detector_puts_the_same_steps_together(
    case: Any, bus: ColourImage, model: Model, runtime: TorchRuntime
) -> None:
    image_size = case["settings"]["imgsz"]
    detector = Detector(runtime, class_names=model.class_names, image_size=image_size, stride=32)
    for image in (bus, ColourImage(np.ascontiguousarray(bus.pixels[..., ::-1]), "rgb")):
        found = detector.detect(image, selection_of(case))
        assert_same(found, case["detections_source_px"], atol_px=0.6 * max(bus.size_hw) / image_size)
