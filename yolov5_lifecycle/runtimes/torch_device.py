"""Where torch runs and with which numbers, from what a user asked for."""

from __future__ import annotations

import torch


class DeviceError(ValueError):
    """The device is absent or cannot do what was asked; the message names what there is."""


def resolve_device(device: str) -> torch.device:
    """The device for auto, cpu, cuda, cuda:N, N (the same as cuda:N) or mps.

    auto is the first CUDA device, else the CPU. Raises DeviceError when the device is absent or the word unknown.
    """
    if device == "auto":
        return torch.device("cuda:0" if torch.cuda.is_available() else "cpu")
    if device == "cpu":
        return torch.device("cpu")
    if device == "mps":
        if not torch.backends.mps.is_available():
            raise DeviceError(f"Device 'mps' is absent: torch sees {_seen()}. Use device 'auto' or 'cpu'.")
        return torch.device("mps")
    return _cuda_device(device)


def resolve_precision(precision: str, device: torch.device) -> torch.dtype:
    """The number format for auto, fp32 or fp16; auto is fp16 on CUDA and fp32 elsewhere.

    Raises DeviceError for fp16 on a CPU and for an unknown word.
    """
    if precision == "auto":
        return torch.float16 if device.type == "cuda" else torch.float32
    if precision == "fp32":
        return torch.float32
    if precision != "fp16":
        raise DeviceError(f"Precision must be auto, fp32 or fp16, found '{precision[:40]}'.")
    if device.type == "cpu":
        raise DeviceError(
            "Precision 'fp16' needs a GPU: a CPU computes half numbers many times slower than fp32, found device "
            "'cpu'. Use precision 'auto' or 'fp32'."
        )
    return torch.float16


def _cuda_device(device: str) -> torch.device:
    kind, _, index = device.rpartition(":") if ":" in device else ("cuda", "", device)
    if device == "cuda":
        index = "0"
    if kind != "cuda" or not (index.isascii() and index.isdigit()):
        raise DeviceError(f"Device must be auto, cpu, cuda, cuda:N, N or mps, found '{device[:40]}'.")
    if not torch.cuda.is_available() or int(index) >= torch.cuda.device_count():
        remedy = "" if torch.version.cuda else " This torch was built without CUDA: install one built with it."
        raise DeviceError(
            f"Device 'cuda:{int(index)}' is absent: torch sees {_seen()}.{remedy} Otherwise use device 'auto' or 'cpu'."
        )
    return torch.device("cuda", int(index))


def _seen() -> str:
    """The devices that torch sees, as a list of their names."""
    devices = ["cpu"]
    if torch.cuda.is_available():
        devices += [f"cuda:{index}" for index in range(torch.cuda.device_count())]
    if torch.backends.mps.is_available():
        devices.append("mps")
    return ", ".join(devices)
