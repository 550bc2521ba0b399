"""Resolution of the device and precision settings for torch."""

from __future__ import annotations

import torch


class DeviceError(ValueError):
    """An absent, unsuitable or broken device or runtime; the message lists alternatives and a fix."""


def resolve_device(device: str) -> torch.device:
    """Resolve auto, cpu, cuda, cuda:N, N (the same as cuda:N) or mps to a torch device.

    auto is the first CUDA device, else the CPU. Raises DeviceError.
    """
    if device == "auto":
        return torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    resolved = torch.device(device) if device in ("cpu", "mps") else _cuda_device(device)
    present = devices_present()
    if str(resolved) not in present:
        raise DeviceError(
            f"Device '{resolved}' is absent: torch {torch.__version__} sees {', '.join(present)}. Use one of "
            f"these or 'auto', or install the driver and a torch built for '{resolved.type}'."
        )
    return resolved


def resolve_precision(precision: str, device: torch.device) -> torch.dtype:
    """Resolve auto, fp32 or fp16 to a dtype; auto is fp16 on CUDA and fp32 elsewhere.

    Raises DeviceError for fp16 on a CPU and for an unknown precision.
    """
    if precision == "auto":
        return torch.float16 if device.type == "cuda" else torch.float32
    if precision not in ("fp32", "fp16"):
        raise DeviceError(f"Precision must be auto, fp32 or fp16, found {precision[:40]!r}.")
    if precision == "fp16" and device.type == "cpu":
        raise DeviceError(
            "Precision 'fp16' needs a GPU, found device 'cpu', where fp16 is slower than fp32. "
            "Use precision 'auto' or 'fp32'."
        )
    return torch.float16 if precision == "fp16" else torch.float32


def devices_present() -> list[str]:
    """Names of the devices available to torch."""
    devices = ["cpu"]
    if torch.cuda.is_available():
        devices += [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    if torch.backends.mps.is_available():
        devices.append("mps")
    return devices


def _cuda_device(device: str) -> torch.device:
    index = "0" if device == "cuda" else device.removeprefix("cuda:")
    # torch stores the index in eight bits.
    if not (index.isascii() and index.isdigit() and len(index) < 4 and int(index) < 128):
        raise DeviceError(f"Device must be auto, cpu, cuda, cuda:N, N or mps, found {device[:40]!r}.")
    return torch.device("cuda", int(index))
