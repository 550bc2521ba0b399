"""What torch sees is compared with the driver that the machine has."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from support.doctor_process import planted

from yolov5_lifecycle.doctor.devices import CHECKS
from yolov5_lifecycle.doctor.finding import Machine


@pytest.fixture(autouse=True)
def _has_no_gpu() -> None:
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU, so nothing is wrong with its driver")


def test_a_driver_without_a_torch_that_uses_it_is_found(tmp_path: Path) -> None:
    planted(tmp_path, {"/proc/driver/nvidia/version": "Kernel Module  535.129.03\n"})
    (finding,) = CHECKS["torch"](Machine(tmp_path))
    if torch.version.cuda is None:
        assert finding.level == "warning"
        assert finding.found.endswith("has no CUDA, so the GPU is not used")
        assert "`make install` without TORCH=cpu" in finding.remedy
    else:
        assert finding.level == "error"
        assert "finds no usable GPU: " in finding.found
        assert "Update NVIDIA's driver" in finding.remedy


def test_a_machine_without_a_driver_uses_the_cpu(tmp_path: Path) -> None:
    (finding,) = CHECKS["torch"](Machine(tmp_path))
    assert finding.level == "ok"
    assert finding.found.endswith("on the CPU only")
