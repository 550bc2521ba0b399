"""`doctor` on a machine that is broken in one way says what is wrong and what helps."""

from __future__ import annotations

import os
import sys
import sysconfig
import venv
from collections.abc import Mapping
from pathlib import Path

import pytest
from support.doctor_process import doctor, of, planted
from support.recorded_scene import video

from yolov5_lifecycle.doctor.finding import Machine
from yolov5_lifecycle.doctor.private_names import without_private_names
from yolov5_lifecycle.doctor.system import CHECKS

CPU = "/sys/fs/cgroup/robot.slice/cpu.max"
GROUP = {"/proc/self/cgroup": "0::/robot.slice/detector\n"}
KERNEL = "NVRM version: NVIDIA UNIX x86_64 Kernel Module  535.129.03  Thu Oct 19 18:56:32 UTC 2023\n"
OPEN_KERNEL = "NVRM version: NVIDIA UNIX Open Kernel Module for x86_64  550.54.15  Release Build\n"
GPU = {"/sys/bus/pci/devices/0000:01:00.0/vendor": "0x10de\n"}
LIBRARY = "/usr/lib/x86_64-linux-gnu/libcuda.so."


@pytest.mark.parametrize(
    ("files", "subject", "level", "found", "remedy"),
    [
        pytest.param(
            {**GROUP, CPU: "50000 100000\n"},
            *("processor", "warning", "the control group allows 0.5", "OMP_NUM_THREADS=1"),
            id="half a processor",
        ),
        pytest.param(
            {
                "/sys/fs/cgroup/cpu/cpu.cfs_quota_us": "50000\n",
                "/sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n",
            },
            *("processor", "warning", "the control group allows 0.5", "--cpus of Docker"),
            id="half a processor in version 1",
        ),
        pytest.param({**GROUP, CPU: "max 100000\n"}, "processor", "ok", "processors", "", id="no limit"),
        pytest.param(
            {**GROUP, "/sys/fs/cgroup/memory.max": f"{256 << 20}\n"},
            *("memory", "error", "0.2 GiB is the limit of the control group", "--memory of Docker"),
            id="little memory for the group",
        ),
        pytest.param(
            {"/sys/fs/cgroup/memory/memory.limit_in_bytes": "9223372036854771712\n"},
            *("memory", "ok", "not known", ""),
            id="no limit in version 1",
        ),
        pytest.param(
            {"/proc/meminfo": "MemTotal: 4096000 kB\nMemAvailable: 1048576 kB\n"},
            *("memory", "warning", "1.0 GiB is available", "End other programs"),
            id="little memory",
        ),
    ],
)
def test_a_limit_of_the_system_is_found(
    tmp_path: Path, files: Mapping[str, str], subject: str, level: str, found: str, remedy: str
) -> None:
    (finding,) = CHECKS["system"][subject](Machine(planted(tmp_path, files)))
    assert finding.level == level
    assert found in finding.found
    assert remedy in finding.remedy


@pytest.mark.parametrize(
    ("limits", "subject", "level", "found", "remedy"),
    [
        ({"RLIMIT_NOFILE": 64}, "limits", "error", "64 open files", "ulimit -n 4096"),
        ({"RLIMIT_NOFILE": 512}, "limits", "warning", "512 open files", "ulimit -n 4096"),
        ({"RLIMIT_AS": 3 << 30}, "memory", "warning", "3.0 GiB of address space", "ulimit -v unlimited"),
    ],
    ids=["no files", "few files", "little address space"],
)
def test_a_limit_of_the_process_is_found(
    limits: Mapping[str, int], subject: str, level: str, found: str, remedy: str
) -> None:
    row = of(doctor("--only", "system", limits=limits), subject)
    assert (row.level, row.found) == (level, found)
    assert remedy in row.remedy


def test_a_cache_is_tried_and_left_as_it_was(tmp_path: Path) -> None:
    row = of(doctor("--only", "system", environment={"XDG_CACHE_HOME": str(tmp_path)}), "cache")
    assert row.level in ("ok", "warning")  # the disk may be full
    assert without_private_names(f"{tmp_path}/yolov5_lifecycle/choices can be written") in row.found
    assert [file for file in tmp_path.rglob("*") if file.is_file()] == []


def test_a_cache_that_cannot_be_written_is_found(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file where a folder should be")
    row = of(doctor("--only", "system", environment={"XDG_CACHE_HOME": f"{tmp_path}/cache"}), "cache")
    assert row.level == "warning"
    assert "cannot be written" in row.found
    assert "set XDG_CACHE_HOME to another folder" in row.remedy


def test_a_second_numpy_on_the_path_is_found(tmp_path: Path) -> None:
    planted(tmp_path, {"numpy/__init__.py": "__version__ = '1.21.0'\n"})
    rows = doctor("--only", "packages", environment={"PYTHONPATH": str(tmp_path)})
    row = of(rows, "duplicates")
    assert row.level == "warning"
    assert row.found.startswith(f"numpy is loaded from {without_private_names(str(tmp_path))} and hides ")
    assert row.remedy.startswith(f"Remove {without_private_names(str(tmp_path))} from PYTHONPATH")
    assert of(rows, "packages").found == "numpy 1.21.0, expected 1.26 or newer"


@pytest.mark.long
@pytest.mark.parametrize(
    ("program", "found"),
    [
        pytest.param("raise RuntimeError('planted')", "import numpy: RuntimeError: planted", id="raises"),
        pytest.param("import ctypes; ctypes.string_at(0)", "it ended with Segmentation fault", id="crashes"),
    ],
)
def test_a_package_that_fails_when_imported_is_one_line(tmp_path: Path, program: str, found: str) -> None:
    planted(tmp_path, {"numpy/__init__.py": program})
    rows = doctor("--only", "packages", environment={"PYTHONPATH": str(tmp_path)})
    row = of(rows, "packages")
    assert row.level == "error"
    assert found in row.found
    assert of(rows, "duplicates").level == "warning"  # the checks behind it were made


def test_pips_opencv_in_front_of_apts_is_found(tmp_path: Path) -> None:
    venv.create(tmp_path, with_pip=False, symlinks=True)
    first = Path(sysconfig.get_path("purelib", vars={"base": str(tmp_path)}))
    for name in ("opencv_python", "opencv_contrib_python"):
        metadata = f"Metadata-Version: 2.1\nName: {name.replace('_', '-')}\nVersion: 4.9.0\n"
        planted(first, {f"{name}-4.9.0.dist-info/METADATA": metadata})
    planted(first, {"cv2/__init__.py": "__version__ = '4.9.0'\n"})
    apts = Path(sysconfig.get_path("purelib"))
    (first / "apt.pth").write_text("\n".join([str(apts), *filter(None, sys.path)]))
    rows = doctor("--only", "packages", python=tmp_path / "bin" / "python")
    row = of(rows, "duplicates")
    assert row.found == without_private_names(f"cv2 is loaded from {first} and hides {apts}")
    assert "-m pip uninstall opencv-contrib-python" in row.remedy
    row = of(rows, "OpenCV")
    assert row.found.startswith("opencv-contrib-python and opencv-python are in the same folder cv2")
    assert "then install opencv-python-headless" in row.remedy


@pytest.mark.parametrize(
    ("files", "level", "found", "remedy"),
    [
        pytest.param(
            {"/proc/driver/nvidia/version": KERNEL, f"{LIBRARY}550.54.15": "", f"{LIBRARY}1": ""},
            *("error", "driver 535.129.03, libcuda.so is of 550.54.15", "Restart the machine"),
            id="driver updated, not restarted",
        ),
        pytest.param(
            {"/proc/driver/nvidia/version": OPEN_KERNEL, f"{LIBRARY}550.54.15": ""},
            *("ok", "NVIDIA driver 550.54.15", ""),
            id="a good driver",
        ),
        pytest.param(
            {**GPU, "/sys/bus/pci/devices/0000:01:00.0/class": "0x030000\n"},
            *("warning", "an NVIDIA GPU without a driver", "sudo ubuntu-drivers install"),
            id="no driver",
        ),
        pytest.param(
            {**GPU, "/sys/bus/pci/devices/0000:01:00.0/class": "0x020000\n"},
            *("ok", "no NVIDIA GPU", ""),
            id="a network card of NVIDIA",
        ),
        pytest.param(
            {f"{LIBRARY}550.54.15": ""},
            *("warning", "no driver in the kernel", "sudo modprobe nvidia"),
            id="driver not loaded",
        ),
    ],
)
def test_the_two_halves_of_the_gpu_driver_are_compared(
    tmp_path: Path, files: Mapping[str, str], level: str, found: str, remedy: str
) -> None:
    (finding,) = CHECKS["driver"]["NVIDIA driver"](Machine(planted(tmp_path, files)))
    assert finding.level == level
    assert found in finding.found
    assert remedy in finding.remedy


def test_a_damaged_library_of_cuda_is_found(tmp_path: Path) -> None:
    planted(tmp_path, {"libcuda.so.1": "no library at all"})
    row = of(doctor("--only", "driver", environment={"LD_LIBRARY_PATH": str(tmp_path)}), "NVIDIA driver")
    assert row.level == "error"
    assert row.found.startswith("libcuda.so.1 cannot be loaded: ")
    assert "LD_LIBRARY_PATH" in row.remedy


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


def test_a_machine_without_cameras_has_no_line_about_them(tmp_path: Path) -> None:
    assert doctor("--only", "camera", root=tmp_path) == []


@pytest.mark.long  # it imports torch
def test_a_runtime_that_cannot_be_imported_is_found(tmp_path: Path) -> None:
    planted(tmp_path, {"onnxruntime/__init__.py": "raise RuntimeError('planted')"})
    rows = doctor("--only", "runtime", "--time", "600", environment={"PYTHONPATH": str(tmp_path)})
    row = of(rows, "runtime onnxruntime")
    assert (row.level, row.found) == ("error", "RuntimeError: planted")
    assert "pip install --force-reinstall onnxruntime" in row.remedy
    assert of(rows, "runtime openvino").level == "ok"
