"""The machine: system, Python and its packages, processor, memory, limits, NVIDIA's driver, cameras."""

from __future__ import annotations

import math
import os
import platform
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from importlib.machinery import PathFinder
from importlib.metadata import distributions, requires, version
from pathlib import Path

from yolov5_lifecycle.doctor.finding import Finding, Groups, Machine, error, ok, warning
from yolov5_lifecycle.printable import shell_command
from yolov5_lifecycle.process.environment import compute_threads
from yolov5_lifecycle.process.memory import available_bytes, cores, memory_bytes
from yolov5_lifecycle.process.missing_package import PIP_PACKAGES
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

_MODULES = {package: module for module, package in PIP_PACKAGES.items()}
_IMPORTED = ("annotated_types", "cv2", "numpy", "pydantic", "pydantic_core", "safetensors", "yaml")
"""Always needed and quickly imported; torch and the runtimes are imported in processes of their own."""
_ONCE = ("cv2", "numpy", "onnx", "onnxruntime", "openvino", "pydantic", "rclpy", "scipy", "torch", "yaml")
"""Of which a second copy leads to errors that name neither."""
_REQUIREMENT = re.compile(r"([\w.-]+)(?:\s*\(?>=\s*([\d.]+))?")


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


def _required(_: Machine) -> Iterator[Finding]:
    """Raises what the import of a missing or broken package raises."""
    present = [f"yolov5_lifecycle {version('yolov5_lifecycle')}"]
    for package, oldest, is_optional in dict.fromkeys(_requirements()):
        module = _MODULES.get(package, package)
        try:
            loaded = import_module(module) if module in _IMPORTED else None
            found = getattr(loaded, "__version__", None) or version(package)
        except ModuleNotFoundError:
            if is_optional:
                continue
            raise
        present.append(f"{package} {found}")
        if _numbers(found) < _numbers(oldest):
            yield error(
                f"{package} {found}, expected {oldest} or newer",
                remedy=f'{sys.executable} -m pip install "{package}>={oldest}"',
            )
    yield ok(", ".join(present))


def _requirements() -> Iterator[tuple[str, str, bool]]:
    """Packages of pip, their oldest supported versions, and whether only an extra needs them."""
    for line in requires("yolov5_lifecycle") or []:
        parts = _REQUIREMENT.match(line)
        assert parts is not None
        yield parts[1], parts[2] or "0", "extra ==" in line and "opencv" not in line


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text.partition("+")[0])[:3])


def _duplicates(_: Machine) -> Iterator[Finding]:
    doubled = {module: places for module in _ONCE if len(places := _copies(module)) > 1}
    for module, (used, *hidden) in doubled.items():
        package = PIP_PACKAGES.get(module, module)
        if module == "cv2":  # which several packages of pip have
            names = (str(each.name) for each in distributions(path=[used]))
            package = next((name for name in names if name.startswith("opencv")), package)
        uninstall = shell_command(sys.executable, "-m", "pip", "uninstall", package)
        is_given = used in os.environ.get("PYTHONPATH", "").split(os.pathsep)
        what_to_do = f"Remove {used} from PYTHONPATH" if is_given else f"Uninstall one, such as `{uninstall}`"
        yield warning(
            f"{module} is loaded from {used} and hides {', '.join(hidden)}",
            remedy=f"{what_to_do}, because compiled packages fit only one of the two.",
        )
    if not doubled:
        yield ok("no package is there twice")


def _copies(module: str) -> list[str]:
    """The folders of sys.path from which `module` could be imported, the one that is used first."""
    places: dict[Path, str] = {}
    for entry in filter(None, sys.path):
        spec = PathFinder.find_spec(module, [entry])
        if spec is not None and spec.origin is not None:
            places.setdefault(Path(spec.origin).resolve(), entry)
    return list(dict.fromkeys(places.values()))


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
        "is available": available_bytes(machine.text),
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
    },
    # The one that imports packages comes last: a broken one may end the process.
    "packages": {"duplicates": _duplicates, "packages": _required},
    "driver": {"NVIDIA driver": _driver},
    "camera": {"camera": _camera},
}
