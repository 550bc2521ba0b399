"""The machine: system, Python, processor, memory, limits, folder of the cache, NVIDIA's driver, cameras."""

from __future__ import annotations

import math
import os
import platform
import re
import sys
from collections.abc import Iterator
from contextlib import suppress

from yolov5_lifecycle.doctor.finding import Finding, Groups, Machine, error, ok, warning
from yolov5_lifecycle.process.control_group import cores, memory_bytes
from yolov5_lifecycle.process.environment import compute_threads
from yolov5_lifecycle.process.memory import available_bytes
from yolov5_lifecycle.runtimes.cache import NO_PLACE, cache_folder, write_cache
from yolov5_lifecycle.runtimes.processor import abilities

_GIB = 1 << 30
OLDEST_PYTHON, NEWEST_PYTHON = (3, 10), (3, 13)
"""What has been tried; setup.py and requirements/check_machine.py have the same, as a test compares."""
_NEEDED_MEMORY, _ENOUGH_MEMORY = _GIB // 2, 2 * _GIB
KERNEL_MODULE = "/proc/driver/nvidia/version"
_VENDOR, _DISPLAY = "0x10de", "0x03"  # of PCI devices
_LIBRARY_FOLDERS = (
    *("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/local/nvidia/lib64"),
)


def _system(machine: Machine) -> Iterator[Finding]:
    name = platform.system()
    with suppress(OSError):
        name = platform.freedesktop_os_release()["PRETTY_NAME"]
    is_contained = any(machine.path(mark).exists() for mark in ("/.dockerenv", "/run/.containerenv"))
    where = ", in a container" if is_contained else ""
    yield ok(f"{name}, {platform.system()} {platform.release()}, {platform.machine()}{where}")


def _python(_: Machine) -> Iterator[Finding]:
    inside = [name for name in ("VIRTUAL_ENV", "CONDA_PREFIX", "PYTHONPATH") if os.environ.get(name)]
    found = f"Python {platform.python_version()}, {sys.executable}"
    found += f"; {', '.join(inside)} set" if inside else ""
    tried = "Python {}.{} to {}.{}".format(*OLDEST_PYTHON, *NEWEST_PYTHON)
    if OLDEST_PYTHON <= sys.version_info[:2] <= NEWEST_PYTHON:
        yield ok(found)
    else:
        yield warning(found, remedy=f"Install {tried}, and this package into it: nobody has tried another.")


def _processor(machine: Machine) -> Iterator[Finding]:
    count, quota, known = compute_threads(), cores(machine.text), abilities()
    found = f"{count} processors, {', '.join(known) or 'no vector instructions known'}"
    if quota is not None and quota < int(os.environ.get("OMP_NUM_THREADS", "").partition(",")[0] or count):
        yield warning(
            f"{found}; the control group allows {quota:g}",
            remedy=f"Start the node with OMP_NUM_THREADS={max(1, math.floor(quota))}, because more threads "
            "wait for each other, or raise the limit (--cpus of Docker, CPUQuota= of systemd).",
        )
    elif platform.machine() == "x86_64" and "avx2" not in known:
        yield warning(found, remedy="Use a small image_size and model: without AVX2 inference is slow.")
    else:
        yield ok(found)


def _memory(machine: Machine) -> Iterator[Finding]:
    limits = {
        "is available": available_bytes(machine.path("/proc/meminfo")),
        "is the limit of the control group": memory_bytes(machine.text),
    }
    known = {name: value for name, value in limits.items() if value is not None}
    found = ", ".join(f"{value / _GIB:.1f} GiB {name}" for name, value in known.items()) or "not known"
    least = min(known.values(), default=math.inf)
    if least >= _ENOUGH_MEMORY:
        yield ok(found)
    else:
        yield (error if least < _NEEDED_MEMORY else warning)(
            found,
            remedy="End other programs or raise the limit (--memory of Docker, MemoryMax= of systemd): with "
            "too little, the kernel kills the detector.",
        )


def _cache(_: Machine) -> Iterator[Finding]:
    try:
        folder = cache_folder().expanduser()
        write_cache(folder / "doctor", "")
        (folder / "doctor").unlink()
    except NO_PLACE as problem:
        yield warning(
            f"the folder of the cache cannot be written: {problem}",
            remedy="Give this user the right to write it, or set XDG_CACHE_HOME to another folder: without a "
            "cache, each start compares the runtimes again, which takes about 2 s.",
        )
    else:
        yield ok(f"{folder} can be written")


def _driver(machine: Machine) -> Iterator[Finding]:
    kernel = re.search(r"Kernel Module\b.*?\s(\d+\.[\d.]+)", machine.text(KERNEL_MODULE))
    files = [file.name for folder in _LIBRARY_FOLDERS for file in machine.path(folder).glob("libcuda.so.*.*")]
    libraries = {name.removeprefix("libcuda.so.") for name in files}
    if kernel is None and _has_gpu(machine):
        yield warning(
            "an NVIDIA GPU without a driver in the kernel",
            remedy="Install the driver (on Ubuntu `sudo ubuntu-drivers install`) and restart; give a "
            "container the GPU with --gpus all. Until then the detector uses the CPU.",
        )
    elif kernel is None:
        yield ok("no NVIDIA GPU: the detector uses the CPU")
    elif libraries and kernel[1] not in libraries:
        yield error(
            f"the kernel has NVIDIA's driver {kernel[1]}, libcuda.so is of {', '.join(sorted(libraries))}",
            remedy="Restart the machine: the driver was updated, and the kernel still has the old one. In a "
            "container, start a new one.",
        )
    else:
        yield ok(f"NVIDIA driver {kernel[1]}")


def _has_gpu(machine: Machine) -> bool:
    """Whether the machine has an NVIDIA GPU on its PCI bus, with or without a driver."""
    return any(
        vendor.read_text().strip() == _VENDOR and vendor.with_name("class").read_text().startswith(_DISPLAY)
        for vendor in machine.path("/sys/bus/pci/devices").glob("*/vendor")
    )


def _camera(machine: Machine) -> Iterator[Finding]:
    """One image of the device, which may also belong to something that sends none."""
    from yolov5_lifecycle.sources.frames import SourceError  # OpenCV, which the other checks do not need
    from yolov5_lifecycle.sources.source import open_source

    device = machine.path(machine.target)
    if not os.access(device, os.R_OK | os.W_OK):
        yield error(
            "this user may not open it",
            remedy="Add the user to the group of the device with `sudo usermod -aG video $USER` and log in "
            "again; give a container the device with --device.",
        )
        return
    try:
        height, width = next(open_source(str(device)).frames).image.size_hw
    except SourceError as problem:
        # The driver of USB cameras adds a second device, with the description of the images.
        if machine.text(f"/sys/class/video4linux/{device.name}/index").strip() not in ("", "0"):
            yield ok("sends no images: it belongs to another device of the same camera")
        else:
            yield warning(
                str(problem),
                remedy="End the program that uses the camera (`sudo fuser -v /dev/video*`), or plug it in "
                "again; ignore this line if the device is no camera.",
            )
    else:
        yield ok(f"one image of {width}x{height} received")


CHECKS: Groups = {
    "system": {
        "system": _system,
        "Python": _python,
        "processor": _processor,
        "memory": _memory,
        "cache": _cache,
    },
    "driver": {"NVIDIA driver": _driver},
    "camera": {"camera": _camera},
}
