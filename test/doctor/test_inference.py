"""Detections of one image are compared, and what torch sees with the driver that the machine has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from support.doctor_process import planted

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.doctor.finding import Machine
from yolov5_lifecycle.doctor.inference import CHECKS, EXACT, difference

without_gpu = pytest.mark.skipif(
    torch.cuda.is_available(), reason="nothing is wrong with the driver of the GPU"
)
Row = tuple[int, float, tuple[float, float, float, float]]
CIRCLE: Row = (0, 0.9, (10, 10, 50, 50))
STAR: Row = (3, 0.8, (100, 10, 150, 60))


def detections(*rows: Row) -> Detections:
    return Detections(
        np.array([box for _, _, box in rows], np.float32).reshape(-1, 4),
        np.array([score for _, score, _ in rows], np.float32),
        np.array([class_id for class_id, _, _ in rows], np.int64),
    )


@pytest.mark.parametrize(
    ("found", "problem"),
    [
        pytest.param([CIRCLE, STAR], "", id="equal"),
        pytest.param([(0, 0.905, (10.5, 10, 50, 50)), STAR], "", id="nearly"),
        pytest.param([CIRCLE, STAR, (1, 0.255, (0, 0, 9, 9))], "", id="on the threshold"),
        pytest.param([CIRCLE], "it lacks star 0.80 at [100, 10, 150, 60]", id="one less"),
        pytest.param([], "it lacks circle 0.90 at [10, 10, 50, 50]", id="none"),
        pytest.param([CIRCLE, STAR, (1, 0.5, (0, 0, 9, 9))], "it also has square 0.50", id="one more"),
        pytest.param([(1, 0.9, (10, 10, 50, 50)), STAR], "it lacks circle", id="another class"),
        pytest.param([(0, 0.9, (12, 10, 50, 50)), STAR], "it lacks circle", id="elsewhere"),
        pytest.param([(0, 0.85, (10, 10, 50, 50)), STAR], "it lacks circle", id="another score"),
    ],
)
def test_two_results_are_compared(found: list[Row], problem: str) -> None:
    told = difference(detections(CIRCLE, STAR), detections(*found), EXACT)
    assert told.startswith(problem)
    assert bool(told) == bool(problem)


def test_nothing_is_the_same_as_nothing() -> None:
    assert difference(detections(), detections(), EXACT) == ""


def test_the_network_finds_every_shape_of_the_image() -> None:
    first, *_ = CHECKS["devices"]["forward"](Machine())
    assert first.found.startswith("cpu fp32: all 6 shapes found, ")


@without_gpu
def test_a_driver_without_a_torch_that_uses_it_is_found(tmp_path: Path) -> None:
    planted(tmp_path, {"/proc/driver/nvidia/version": "Kernel Module  535.129.03\n"})
    (finding,) = CHECKS["devices"]["torch"](Machine(tmp_path))
    if torch.version.cuda is None:
        assert finding.level == "warning"
        assert finding.found.endswith("has no CUDA, so the GPU is not used")
        assert "`make install` without TORCH=cpu" in finding.remedy
    else:
        assert finding.level == "error"
        assert "finds no usable GPU: " in finding.found
        assert "Update NVIDIA's driver" in finding.remedy


@without_gpu
def test_a_machine_without_a_driver_uses_the_cpu(tmp_path: Path) -> None:
    (finding,) = CHECKS["devices"]["torch"](Machine(tmp_path))
    assert finding.level == "ok"
    assert finding.found.endswith("on the CPU only")
