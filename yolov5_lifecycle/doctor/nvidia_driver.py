"""The driver of NVIDIA GPUs: whether its two halves are there and fit together."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator, Mapping
from types import MappingProxyType

from yolov5_lifecycle.doctor.finding import Check, Finding, Machine, error, ok, warning

KERNEL_MODULE = "/proc/driver/nvidia/version"
_VENDOR, _DISPLAY = "0x10de", "0x03"  # of PCI devices
_LIBRARY_FOLDERS = (
    *("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64", "/usr/local/nvidia/lib64"),
)
_NO_DEVICE = 100


def has_gpu(machine: Machine) -> bool:
    """Whether the machine has an NVIDIA GPU on its PCI bus, with or without a driver."""
    devices = machine.path("/sys/bus/pci/devices").glob("*")
    names = (f"/sys/bus/pci/devices/{device.name}" for device in devices)
    return any(
        machine.text(f"{name}/vendor").strip() == _VENDOR
        and machine.text(f"{name}/class").startswith(_DISPLAY)
        for name in names
    )


def _driver(machine: Machine) -> Iterator[Finding]:
    kernel = re.search(r"Kernel Module\b.*?\s(\d+\.[\d.]+)", machine.text(KERNEL_MODULE))
    libraries = _library_versions(machine)
    if kernel is None:
        yield _absence(machine, libraries)
    elif libraries and kernel[1] not in libraries:
        yield error(
            f"the kernel has NVIDIA's driver {kernel[1]}, libcuda.so is of {', '.join(sorted(libraries))}",
            remedy="Restart the machine: the driver was updated, and the kernel still has the old one. In a "
            "container, start a new one.",
        )
    else:
        yield ok(f"NVIDIA driver {kernel[1]}")
    yield from _library()


def _library_versions(machine: Machine) -> set[str]:
    names = [file.name for folder in _LIBRARY_FOLDERS for file in machine.path(folder).glob("libcuda.so.*")]
    return {found[1] for name in names if (found := re.fullmatch(r"libcuda\.so\.(\d+\.[\d.]+)", name))}


def _absence(machine: Machine, libraries: set[str]) -> Finding:
    if has_gpu(machine):
        return warning(
            "an NVIDIA GPU without a driver",
            remedy="Install the driver (on Ubuntu `sudo ubuntu-drivers install`) and restart; give a "
            "container the GPU with --gpus all. Until then the detector uses the CPU.",
        )
    if libraries:
        return warning(
            f"libcuda.so of {', '.join(sorted(libraries))}, but no driver in the kernel",
            remedy="Load the driver with `sudo modprobe nvidia`, or give the container the GPU with "
            "--gpus all.",
        )
    return ok("no NVIDIA GPU: the detector uses the CPU")


def _library() -> Iterator[Finding]:
    """What CUDA's own library says; nothing where it is not installed."""
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
        code = int(cuda.cuInit(0))
    except (OSError, AttributeError) as problem:
        if not str(problem).startswith("libcuda.so.1: cannot open shared object file"):
            yield error(
                f"libcuda.so.1 cannot be loaded: {problem}",
                remedy="Install NVIDIA's driver again, and remove other copies of libcuda.so.1 from "
                "LD_LIBRARY_PATH: this file is damaged or for another processor.",
            )
        return
    if code not in (0, _NO_DEVICE):
        text = ctypes.c_char_p()
        cuda.cuGetErrorString(code, ctypes.byref(text))
        yield error(
            f"CUDA cannot start: error {code}, {(text.value or b'unknown').decode(errors='replace')}",
            remedy="Restart the machine; if the error stays, install NVIDIA's driver again.",
        )


CHECKS: Mapping[str, Check] = MappingProxyType({"NVIDIA driver": _driver})
