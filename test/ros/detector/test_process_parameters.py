"""Parameters and states of the installed detector, with the embedded model."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from support.detector_process import (
    WEIGHTS,
    DetectorProcess,
    scene_image,
    scene_truth,
)
from support.random_model import blank_model
from support.sighting import Sighting

from benchmark.process_memory import resident_mb
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.architecture import SIZES
from yolov5_lifecycle.runtimes.cache import cache_folder
from yolov5_lifecycle.tracking.assignment import iou_matrix


@pytest.mark.parametrize("classes", [["circle", "star"], ["0", "3"]], ids=["names", "indices"])
def test_a_class_filter_applies_to_the_next_frame(active: DetectorProcess, classes: list[str]) -> None:
    everything = set(active.look().class_names)
    assert everything > {"circle", "star"}
    assert active.node.set_parameters(classes=classes) == ""
    assert set(active.look().class_names) == {"circle", "star"}
    assert active.node.set_parameters(classes=[]) == ""
    assert set(active.look().class_names) == everything


def test_a_limit_on_detections_applies_to_the_next_frame(active: DetectorProcess) -> None:
    best = active.look()
    assert active.node.set_parameters(max_detections=2) == ""
    assert active.look().scores == best.scores[:2]


def test_agnostic_nms_applies_to_the_next_frame(active: DetectorProcess) -> None:
    assert active.node.set_parameters(confidence_threshold=0.0001, iou_threshold=0.0) == ""
    assert _largest_overlap(active.look()) > 0.05
    assert active.node.set_parameters(agnostic_nms=True) == ""
    assert _largest_overlap(active.look()) < 0.01


def _largest_overlap(found: Sighting) -> float:
    ious = iou_matrix(found.boxes_xyxy, found.boxes_xyxy)
    return float(np.triu(ious, k=1).max(initial=0))


def test_another_image_size_is_swapped_in_while_active(active: DetectorProcess) -> None:
    assert active.node.set_parameters(image_size=416) == ""
    assert active.look().found_of(scene_truth()) >= len(scene_truth().scores) - 1
    refusal = active.node.set_parameters(image_size=417)
    assert "image_size" in refusal
    assert active.node.parameter("image_size") == 416
    assert active.node.state() == "active"


def test_missing_weights_are_named_with_the_remedy_and_may_be_given_then(detector: DetectorProcess) -> None:
    assert detector.node.set_parameters(weights="/nowhere/shapes.safetensors") == ""
    detector.bring_to("inactive")
    assert not detector.transition("activate")
    problem = detector.status()["last problem"]
    assert "/nowhere/shapes.safetensors" in problem
    assert "check the path" in problem
    assert detector.node.state() == "inactive"
    assert detector.node.set_parameters(weights=WEIGHTS) == ""
    assert detector.transition("activate")
    assert len(detector.look().scores) > 0


@pytest.fixture(scope="module")
def large_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file whose network takes 85 MB."""
    path = tmp_path_factory.mktemp("large") / "yolov5m.safetensors"
    write_safetensors(blank_model(SIZES["m"]), path)
    return path


@pytest.mark.parametrize(
    "runtime",
    [
        pytest.param("torch", marks=pytest.mark.long),
        "onnxruntime",
        pytest.param("openvino", marks=pytest.mark.long),
    ],
)
def test_deactivate_releases_the_memory_of_the_model(
    detector: DetectorProcess, large_weights: Path, runtime: str
) -> None:
    if runtime != "torch":
        pytest.importorskip(runtime)
    assert detector.node.set_parameters(weights=str(large_weights), runtime=runtime, image_size=64) == ""
    detector.bring_to("active")
    detector.bring_to("inactive")  # what a runtime brings once, its code, stays
    before_mb = resident_mb(detector.process.process_id)
    for _ in range(2):
        detector.bring_to("active")
        assert resident_mb(detector.process.process_id) > before_mb + 80
        detector.bring_to("inactive")
        assert resident_mb(detector.process.process_id) < before_mb * 1.1


def test_a_damaged_compiled_model_is_recompiled(active: DetectorProcess) -> None:
    pytest.importorskip("onnxruntime")
    assert active.node.set_parameters(runtime="onnxruntime") == ""
    expected = Sighting.of(active.detect(scene_image(7)))
    assert active.transition("deactivate")
    damaged = b"damaged"
    for file in cache_folder("compiled").iterdir():
        file.write_bytes(damaged)
    assert active.transition("activate")
    found = Sighting.of(active.detect(scene_image(7)))
    assert found.class_names == expected.class_names
    np.testing.assert_allclose(found.scores, expected.scores, atol=1e-5)
    assert any(file.read_bytes() != damaged for file in cache_folder("compiled").iterdir())


def test_a_reset_process_has_no_override_left_that_waits_for_its_camera(detector: DetectorProcess) -> None:
    assert detector.node.set_parameters(**{"side.max_rate": 5.0}) == ""
    assert not detector.transition("configure")
    detector.reset()
    detector.bring_to("inactive")
