"""A running detector changes to int8 and back between two frames, and refuses it without a calibration."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from rclpy.parameter import Parameter
from support.colcon_workspace import REPOSITORY
from support.detector_process import DetectorProcess

from yolov5_lifecycle.quantization.calibration_file import path_beside, read_calibration, write_calibration
from yolov5_lifecycle.runtimes.registry import installed_runtimes

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif("openvino" not in installed_runtimes(), reason="no openvino: make install"),
]


def set_to(detector: DetectorProcess, **values: object) -> tuple[bool, str]:
    messages = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
    results = detector.set_one_by_one(messages)
    return all(result.successful for result in results), "; ".join(result.reason for result in results)


def test_precision_int8_is_a_reload_that_goes_on_finding_the_shapes(
    active: DetectorProcess, tmp_path: Path
) -> None:
    shapes = REPOSITORY / "weights" / "shapes.safetensors"
    weights = Path(shutil.copy(shapes, tmp_path / "best.safetensors"))
    calibration = read_calibration(path_beside(shapes)).model_copy(update={"image_size": 320})
    write_calibration(path_beside(weights), calibration)
    assert set_to(active, weights=str(weights)) == (True, "")
    in_fp32 = active.look(0)
    assert set_to(active, precision="int8") == (True, "")
    status = active.status()
    assert (status["precision"], status["runtime"]) == ("int8", "openvino")
    in_int8 = active.look(1)
    assert abs(len(in_int8.class_names) - len(in_fp32.class_names)) <= 1
    assert set_to(active, precision="auto") == (True, "")
    assert active.status()["precision"] == "fp32"


def test_int8_without_a_calibration_is_refused_and_detection_goes_on(
    active: DetectorProcess, tmp_path: Path
) -> None:
    weights = shutil.copy(REPOSITORY / "weights" / "shapes.safetensors", tmp_path / "best.safetensors")
    assert set_to(active, weights=str(weights))[0]
    done, reason = set_to(active, precision="int8")
    assert not done
    assert f"`calibrate {weights} DATA --image-size 320`" in reason
    assert active.status()["precision"] == "fp32"
    assert len(active.look(0).class_names) > 0
