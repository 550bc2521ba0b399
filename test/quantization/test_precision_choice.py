"""`precision: auto` is int8 only where that is known to be good and faster here."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.calibrations import a_calibration, measurement
from support.random_model import random_model

from yolov5_lifecycle.quantization.calibration_file import Calibration
from yolov5_lifecycle.quantization.precision_choice import (
    PrecisionChoice,
    Wish,
    choose,
    choose_precision,
)
from yolov5_lifecycle.runtimes.auto import computer_digest
from yolov5_lifecycle.runtimes.processor_abilities import abilities, weight_bits
from yolov5_lifecycle.runtimes.registry import installed_runtimes
from yolov5_lifecycle.runtimes.speed import INT8_FIGURES

needs_openvino = pytest.mark.skipif(
    "openvino" not in installed_runtimes(), reason="no openvino: make install"
)
HERE = weight_bits(abilities())
FP32, INT8 = (measurement("fp32", 20.0, 1.0), measurement("int8", 10.0, 0.99))


def chosen(
    folder: Path,
    calibration: Calibration,
    *,
    fp32_ms: float = 20.0,
    processor_ms: float = 60.0,
    runtime: str = "openvino",
    is_free: bool = True,
) -> PrecisionChoice:
    return choose_precision(
        random_model(),
        calibration,
        runtime=runtime,
        is_free=is_free,
        image_size=320,
        frame_hw=(64, 96),
        folder=folder,
        measure=lambda *_, **__: dict(zip(INT8_FIGURES, (fp32_ms, 10.0, processor_ms, 20.0), strict=True)),
    )


@needs_openvino
@pytest.mark.parametrize(
    ("fp32_ms", "precision"), [(20.0, "int8"), (11.5, "int8"), (11.4, "fp32"), (8.0, "fp32")]
)
def test_int8_must_be_faster_here(fp32_ms: float, precision: str, tmp_path: Path) -> None:
    choice = chosen(tmp_path, a_calibration(weight_bits=HERE), fp32_ms=fp32_ms)
    assert choice.precision == precision
    assert f"int8 is {fp32_ms / 10:.2f} x as fast as fp32 here" in choice.reason
    assert "3.00 x by processor time; measured now) and agrees with it to 0.990 (F1)" in choice.reason


@needs_openvino
def test_int8_that_is_faster_only_because_another_process_was_busy_is_not_used(tmp_path: Path) -> None:
    choice = chosen(tmp_path, a_calibration(weight_bits=HERE), fp32_ms=31.4, processor_ms=19.0)
    assert choice.precision == "fp32"
    assert "(10.0 ms, not 31.4; 0.95 x by processor time;" in choice.reason


@needs_openvino
@pytest.mark.parametrize(
    ("int8_ms", "runtime", "is_free", "precision"),
    [
        pytest.param(10.0, "openvino", False, "int8", id="faster"),
        pytest.param(19.0, "openvino", False, "fp32", id="hardly faster"),
        pytest.param(16.0, "onnxruntime", True, "int8", id="faster than both runtimes"),
        pytest.param(17.5, "onnxruntime", True, "fp32", id="hardly faster than the other runtime"),
    ],
)
def test_the_speed_that_calibrate_measured_on_this_computer_decides(
    int8_ms: float, runtime: str, is_free: bool, precision: str, tmp_path: Path
) -> None:
    other = FP32.model_copy(update={"runtime": "onnxruntime", "ms_per_image": 26.0})
    calibration = a_calibration(
        weight_bits=HERE,
        computer_sha256=computer_digest(),
        measured=(other, FP32, measurement("int8", int8_ms, 0.99)),
    )
    choice = chosen(tmp_path, calibration, runtime=runtime, is_free=is_free, fp32_ms=1000.0)
    assert choice.precision == precision
    assert (
        f"({int8_ms:.1f} ms, not 20.0; {20 / int8_ms:.2f} x by processor time; measured by" in choice.reason
    )
    assert list(tmp_path.iterdir()) == []
    assert "measured now" in chosen(tmp_path, calibration, runtime="torch").reason


@needs_openvino
def test_the_speed_is_measured_once(tmp_path: Path) -> None:
    calibration = a_calibration(weight_bits=HERE)
    assert chosen(tmp_path, calibration).precision == "int8"
    again = chosen(tmp_path, calibration, fp32_ms=1.0)
    assert again.precision == "int8"
    (record,) = tmp_path.iterdir()
    assert f"cached in {record}, delete this file to measure again" in again.reason
    record.write_text("{}")
    assert chosen(tmp_path, calibration, fp32_ms=1.0).precision == "fp32"
    assert chosen(tmp_path, calibration, runtime="onnxruntime").reason.count("measured now") == 1


@needs_openvino
@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        pytest.param({"measured": (FP32, measurement("int8", 10.0, 0.979))}, "to 0.979", id="unlike fp32"),
        pytest.param({"measured": (FP32,)}, "not measured", id="never measured"),
        pytest.param({"detections": 49}, "only 49 detections", id="too few detections"),
        pytest.param(
            {"image_size": 640}, "image_size 640, not 320: calibrate with --image-size 320", id="another size"
        ),
        pytest.param({"weight_bits": 15 - HERE}, f"this processor needs {HERE}", id="other weights"),
        pytest.param(
            {"measured": (FP32, INT8.model_copy(update={"map_loss": 1.1}))}, "loses 1.1 points", id="mAP loss"
        ),
    ],
)
def test_int8_must_be_good(changed: dict[str, object], reason: str, tmp_path: Path) -> None:
    choice = chosen(tmp_path, a_calibration(**{"weight_bits": HERE} | changed))
    assert choice.precision == "fp32"
    assert reason in choice.reason
    assert list(tmp_path.iterdir()) == []


def test_a_runtime_that_is_set_is_kept(tmp_path: Path) -> None:
    choice = chosen(tmp_path, a_calibration(weight_bits=HERE), runtime="torch", is_free=False)
    assert choice == PrecisionChoice("fp32", "int8 needs runtime 'openvino', and 'torch' is set")


@needs_openvino
def test_ranges_of_another_network_leave_it_at_fp32(tmp_path: Path) -> None:
    choice = choose_precision(
        random_model(),
        a_calibration(weight_bits=HERE),
        runtime="openvino",
        is_free=True,
        image_size=320,
        frame_hw=(64, 96),
        folder=tmp_path,
    )
    assert choice.precision == "fp32"
    assert choice.reason.startswith("int8 cannot be used: the ranges do not match this network's")


@pytest.mark.parametrize(
    ("wish", "expected"),
    [
        (Wish("cpu", "auto", "int8"), ("openvino", "the only one for int8", "int8", "as set")),
        (Wish("auto", "openvino", "bf16"), ("openvino", "as set", "bf16", "as set")),
        (Wish("cpu", "torch", "fp32"), ("torch", "as set", "fp32", "as set")),
        (Wish("cpu", "torch", "auto"), ("torch", "as set", "fp32", "there is none")),
    ],
    ids=str,
)
def test_what_is_set_is_used(wish: Wish, expected: tuple[str, ...]) -> None:
    used = choose(random_model(), wish, "there is none", image_size=64, frame_hw=(64, 96))
    assert expected == (
        *(used.runtime.runtime, used.runtime.reason),
        *(used.precision.precision, used.precision.reason),
    )
