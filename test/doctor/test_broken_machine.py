"""`doctor` on a machine that is broken in one way says what is wrong and what helps."""

from __future__ import annotations

import os
import sys
import sysconfig
import venv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import torch
from support.doctor_process import doctor, first_on_path, of, planted
from support.recorded_scene import video

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.doctor import inference, system
from yolov5_lifecycle.doctor.finding import Machine, without_private_names

GROUP = {"/proc/self/cgroup": "0::/robot.slice/detector\n"}
KERNEL = "NVRM version: NVIDIA UNIX x86_64 Kernel Module  535.129.03  Thu Oct 19 18:56:32 UTC 2023\n"
OPEN_KERNEL = "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  550.54.15  Release Build\n"
GPU = "/sys/bus/pci/devices/0000:01:00.0"
LIBRARY = "/usr/lib/x86_64-linux-gnu/libcuda.so."


@pytest.mark.parametrize(
    ("files", "subject", "level", "found", "remedy"),
    [
        pytest.param(
            {**GROUP, "/sys/fs/cgroup/robot.slice/cpu.max": "50000 100000\n"},
            *("processor", "warning", "the control group allows 0.5", "OMP_NUM_THREADS=1"),
            id="half a processor",
        ),
        pytest.param(GROUP, "memory", "ok", "not known", "", id="no limit"),
        pytest.param(
            {**GROUP, "/sys/fs/cgroup/memory.max": f"{256 << 20}\n"},
            *("memory", "error", "0.2 GiB is the limit of the control group", "--memory of Docker"),
            id="little memory for the group",
        ),
        pytest.param(
            {"/proc/meminfo": "MemTotal: 4096000 kB\nMemAvailable: 1048576 kB\n"},
            *("memory", "warning", "1.0 GiB is available", "End other programs"),
            id="little memory",
        ),
        pytest.param(
            {"/proc/driver/nvidia/version": KERNEL, f"{LIBRARY}550.54.15": "", f"{LIBRARY}1": ""},
            *("NVIDIA driver", "error", "driver 535.129.03, libcuda.so is of 550.54.15", "Restart the mach"),
            id="driver updated, not restarted",
        ),
        pytest.param(
            {"/proc/driver/nvidia/version": OPEN_KERNEL, f"{LIBRARY}550.54.15": ""},
            *("NVIDIA driver", "ok", "NVIDIA driver 550.54.15", ""),
            id="a good driver",
        ),
        pytest.param(
            {f"{GPU}/vendor": "0x10de\n", f"{GPU}/class": "0x030000\n"},
            *("NVIDIA driver", "warning", "an NVIDIA GPU without a driver", "sudo ubuntu-drivers install"),
            id="no driver",
        ),
        pytest.param(
            {f"{GPU}/vendor": "0x10de\n", f"{GPU}/class": "0x020000\n"},
            *("NVIDIA driver", "ok", "no NVIDIA GPU", ""),
            id="a network card of NVIDIA",
        ),
    ],
)
def test_what_is_wrong_with_a_machine_is_found(
    tmp_path: Path, files: Mapping[str, str], subject: str, level: str, found: str, remedy: str
) -> None:
    checks = system.CHECKS["system"] | system.CHECKS["driver"]
    (finding,) = checks[subject](Machine(planted(tmp_path, files)))
    assert finding.level == level
    assert found in finding.found
    assert remedy in finding.remedy


def test_a_second_numpy_on_the_path_is_found(tmp_path: Path) -> None:
    planted(tmp_path, {"numpy/__init__.py": "__version__ = '1.21.0'\n"})
    rows = doctor("--only", "packages", environment=first_on_path(tmp_path))
    row, folder = of(rows, "duplicates"), without_private_names(str(tmp_path))
    assert row.level == "warning"
    assert row.found.startswith(f"numpy is loaded from {folder} and hides ")
    assert row.remedy.startswith(f"Remove {folder} from PYTHONPATH")
    assert of(rows, "packages").found == "numpy 1.21.0, expected 1.26 or newer"


@pytest.mark.parametrize(
    ("program", "found"),
    [
        pytest.param("raise RuntimeError('planted')", "RuntimeError: planted", id="raises"),
        pytest.param("import ctypes; ctypes.string_at(0)", "it ended with Segmentation fault", id="crashes"),
    ],
)
def test_a_package_that_fails_when_imported_is_one_line(tmp_path: Path, program: str, found: str) -> None:
    planted(tmp_path, {"numpy/__init__.py": program})
    rows = doctor("--only", "packages", environment=first_on_path(tmp_path))
    row = of(rows, "packages")
    assert row.level == "error"
    assert found in row.found
    assert of(rows, "duplicates").level == "warning"  # it was made before


def test_pips_opencv_in_front_of_apts_is_found(tmp_path: Path) -> None:
    venv.create(tmp_path, with_pip=False, symlinks=True)
    first = Path(sysconfig.get_path("purelib", vars={"base": str(tmp_path)}))
    metadata = "Metadata-Version: 2.1\nName: opencv-contrib-python\nVersion: 4.9.0\n"
    planted(first, {"opencv_contrib_python-4.9.0.dist-info/METADATA": metadata})
    planted(first, {"cv2/__init__.py": "__version__ = '4.9.0'\n"})
    apts = Path(sysconfig.get_path("purelib"))
    (first / "apt.pth").write_text("\n".join([str(apts), *filter(None, sys.path)]))
    rows = doctor("--only", "packages", python=tmp_path / "bin" / "python")
    row = of(rows, "duplicates")
    assert row.found == without_private_names(f"cv2 is loaded from {first} and hides {apts}")
    assert "-m pip uninstall opencv-contrib-python" in row.remedy


@pytest.mark.long
def test_every_camera_gets_its_line(tmp_path: Path) -> None:
    devices = planted(tmp_path, {"/dev/video1": "no camera", "/dev/video10": "its second device"}) / "dev"
    planted(tmp_path, {"/sys/class/video4linux/video10/index": "1\n"})
    video(devices / "video2.mp4")
    (devices / "video2.mp4").rename(devices / "video2")
    rows = doctor("--only", "camera", "--time", "600", root=tmp_path)
    assert [row.subject for row in rows] == [f"camera /dev/video{number}" for number in (1, 2, 10)]
    unreadable, good, second = rows
    assert unreadable.level == "warning"
    assert "sudo fuser -v /dev/video*" in unreadable.remedy
    assert good.level == "ok"
    assert good.found.startswith("one image of ")
    assert second.found == "sends no images: it belongs to another device of the same camera"


def test_a_camera_that_never_delivers_hangs_nothing(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    os.mkfifo(tmp_path / "dev" / "video0")  # opens, but nothing ever comes
    (row,) = doctor("--only", "camera", "--time", "12", root=tmp_path)
    assert (row.subject, row.level) == ("camera /dev/video0", "error")
    assert row.found.startswith("no answer within 1 s")
    assert "Plug the camera in again" in row.remedy


@pytest.mark.long  # it imports torch
def test_a_runtime_that_cannot_be_imported_is_found(tmp_path: Path) -> None:
    planted(tmp_path, {"onnxruntime/__init__.py": "raise RuntimeError('planted')"})
    rows = doctor("--only", "runtime", "--time", "600", environment=first_on_path(tmp_path))
    row = of(rows, "runtime onnxruntime")
    assert row.level == "error"
    assert "planted" in row.found
    assert row.remedy.startswith("Uninstall the package onnxruntime")
    assert of(rows, "runtime openvino").level == "ok"


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
        pytest.param([(0, 0.905, (10.5, 10, 50, 50)), STAR], "", id="nearly equal"),
        pytest.param([CIRCLE, STAR, (1, 0.395, (0, 0, 9, 9))], "", id="on the threshold"),
        pytest.param([], "it lacks circle 0.90 at [10, 10, 50, 50]", id="none"),
        pytest.param([CIRCLE, STAR, (1, 0.5, (0, 0, 9, 9))], "it also has square 0.50", id="one more"),
        pytest.param([(1, 0.9, (10, 10, 50, 50)), STAR], "it lacks circle", id="another class"),
        pytest.param([(0, 0.9, (17, 10, 50, 50)), STAR], "it lacks circle", id="elsewhere"),
        pytest.param([STAR, (0, 0.7, (10, 10, 50, 50))], "it lacks circle", id="another score"),
    ],
)
def test_two_results_are_compared(found: list[Row], problem: str) -> None:
    told = inference.difference(detections(CIRCLE, STAR), detections(*found))
    assert told.startswith(problem)
    assert bool(told) == bool(problem)


def lacking(detected: Detections) -> Detections:
    return detections(*zip(detected.class_ids[1:], detected.scores[1:], detected.boxes_xyxy[1:], strict=True))


@pytest.mark.parametrize(
    ("group", "check", "remedy"),
    [
        pytest.param("devices", "forward", "Install torch again", id="torch"),
        pytest.param(
            "runtime", "runtime", "Install it again with pip install --force-reinstall onnx", id="runtime"
        ),
    ],
)
def test_a_device_or_runtime_that_detects_wrongly_is_found(
    monkeypatch: pytest.MonkeyPatch, group: str, check: str, remedy: str
) -> None:
    detect = Detector.detect
    monkeypatch.setattr(Detector, "detect", lambda *arguments: lacking(detect(*arguments)))
    *_, finding = inference.CHECKS[group][check](Machine(target="onnxruntime"))
    assert finding.level == "error"
    assert " differs from the ground truth: it lacks " in finding.found
    assert finding.remedy.startswith(remedy)


@pytest.mark.skipif(torch.cuda.is_available(), reason="nothing is wrong with the driver of the GPU")
def test_a_driver_without_a_torch_that_uses_it_is_found(tmp_path: Path) -> None:
    (finding,) = inference.CHECKS["devices"]["torch"](Machine(tmp_path))
    assert (finding.level, finding.found.rpartition(", ")[2]) == ("ok", "on the CPU only")
    planted(tmp_path, {"/proc/driver/nvidia/version": "Kernel Module  535.129.03\n"})
    (finding,) = inference.CHECKS["devices"]["torch"](Machine(tmp_path))
    if torch.version.cuda is None:
        assert finding.level == "warning"
        assert finding.found.endswith("has no CUDA, so the GPU is not used")
        assert "`make install` without TORCH=cpu" in finding.remedy
    else:
        assert finding.level == "error"
        assert "finds no usable GPU: " in finding.found
        assert "Update NVIDIA's driver" in finding.remedy
