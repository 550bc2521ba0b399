"""The official yolov5n gives the answers that the official pipeline gave."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.onnx_exports import exported
from support.runtime_names import COMPILED_RUNTIMES

from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.checkpoints.onnx_file import read_onnx
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.models.model import Export, Model
from yolov5_lifecycle.runtimes.registry import load_export
from yolov5_lifecycle.runtimes.runtime import Runtime
from yolov5_lifecycle.runtimes.torch_runtime import TorchRuntime

CASE_NAMES = ("defaults", "square frame", "small with one class", "low threshold and agnostic")


@pytest.fixture(scope="module")
def model(reference_dir: Path) -> Model:
    return load_weights(reference_dir / "weights" / "yolov5n.pt").model


@pytest.fixture(scope="module", params=["torch", pytest.param("export", marks=pytest.mark.long)])
def runtime(request: pytest.FixtureRequest, model: Model) -> Iterator[Runtime]:
    runtime: Runtime = TorchRuntime.load(model, device="cpu", precision="fp32")
    if request.param == "export":
        export = read_onnx(exported(model.network(), is_dynamic=True))
        runtime = load_export(export, "onnxruntime", device="cpu", precision="auto")
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


def stride_of(case: Any) -> int:
    """That of the model, or the only one whose multiples up to the size of the image make a square."""
    return 32 if case["settings"]["auto"] else int(case["settings"]["imgsz"])


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


def test_class_names_are_the_official_ones(model: Model, golden: Any) -> None:
    assert list(model.class_names) == golden["names"]


def test_the_letterboxed_image_is_the_same(case: Any, bus: ColourImage) -> None:
    image_size = case["settings"]["imgsz"]
    frame = Letterbox.fit(bus.size_hw, image_size=image_size, stride=stride_of(case)).apply(bus.pixels)
    assert [1, 3, *frame.shape[:2]] == case["network_input_shape"]
    assert frame.sum(dtype=np.int64) == case["letterbox_uint8_sum"]


def test_detections_in_source_pixels_are_the_same(
    case: Any, bus: ColourImage, model: Model, runtime: Runtime
) -> None:
    """YOLOv5 pads by whole pixels but maps back with half ones; we map back what was padded."""
    image_size = case["settings"]["imgsz"]
    detector = Detector(runtime, class_names=model.class_names, image_size=image_size, stride=stride_of(case))
    for image in (bus, ColourImage(np.ascontiguousarray(bus.pixels[..., ::-1]), "rgb")):
        found = detector.detect(image, selection_of(case))
        assert_same(found, case["detections_source_px"], atol_px=0.6 * max(bus.size_hw) / image_size)


@pytest.mark.parametrize("runtime_name", COMPILED_RUNTIMES)
def test_the_official_export_predicts_what_its_pt_predicts(
    runtime_name: str, reference_dir: Path, model: Model, bus: ColourImage
) -> None:
    export = load_weights(reference_dir / "onnx" / "yolov5n_480x640.onnx").content
    assert isinstance(export, Export)
    frame = Letterbox.into(bus.size_hw, (480, 640)).apply(bus.pixels)
    expected = TorchRuntime.load(model, device="cpu", precision="fp32")(frame, bus.channel_order).rows
    found = load_export(export, runtime_name, device="cpu", precision="auto")(frame, bus.channel_order).rows
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize(
    ("name", "image_size", "masks"),
    [("yolov5u_tiny", 320, 0), ("yolov8_seg_tiny", 320, 32), ("yolo11_tiny_dynamic", 416, 0)],
)
def test_official_exports_without_objectness_are_detected_with(
    name: str, image_size: int, masks: int, reference_dir: Path, bus: ColourImage
) -> None:
    export = load_weights(reference_dir / "onnx" / f"{name}.onnx").content
    detector = load_detector(export, image_size=image_size)
    assert detector.class_names == ("circle", "square", "triangle", "star")
    assert detector.mask_coefficients == masks
    assert len(detector.detect(bus, Selection(confidence_threshold=0.001, with_masks=True))) > 0
