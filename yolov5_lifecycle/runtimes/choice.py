"""The fastest runtime of those installed, measured once and remembered."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

import torch

from yolov5_lifecycle.model import Model
from yolov5_lifecycle.runtimes.cache_folder import cache_folder
from yolov5_lifecycle.runtimes.choice_record import read_figures, write_figures
from yolov5_lifecycle.runtimes.loading import REQUIREMENTS, installed_runtimes
from yolov5_lifecycle.runtimes.machine import installed_build, processor
from yolov5_lifecycle.runtimes.speed import measure_ms
from yolov5_lifecycle.runtimes.torch_device import resolve_device, resolve_precision

# Beside one busy process OpenVINO, up to 6 % faster alone, took 8 to 38 % longer than ONNX Runtime.
_PATIENT_FIRST = ("onnxruntime", "openvino", "torch")
_HARDLY_SLOWER = 1.15


@dataclass(frozen=True)
class Choice:
    """A runtime and why it was chosen."""

    runtime: str
    reason: str


def choose_runtime(
    model: Model,
    *,
    device: str,
    precision: str,
    frame_hw: tuple[int, int],
    folder: Path | None = None,
    measure: Callable[..., dict[str, float]] = measure_ms,
) -> Choice:
    """The runtime for `auto`: torch on a GPU; on a CPU the fastest for frames of `frame_hw`.

    What was measured is kept in `folder` (default: the user's cache), so that it is measured once for an
    architecture, a size of frame, the packages as they are installed and a CPU. Raises DeviceError.
    """
    torch_device = resolve_device(device)
    resolve_precision(precision, torch_device)
    installed = installed_runtimes()
    if torch_device.type != "cpu":
        return Choice("torch", f"the only one for {torch_device.type}")
    if installed == ["torch"]:
        return Choice("torch", "the only one installed")
    record = (folder or cache_folder("choices")) / f"{_key(model, installed, frame_hw)}.json"
    figures_ms = read_figures(record, installed)
    if figures_ms is not None:
        return _fastest(figures_ms, f"remembered in {record}")
    figures_ms = measure(model, installed, precision=precision, frame_hw=frame_hw)
    problem = write_figures(record, figures_ms)
    return _fastest(figures_ms, problem or "measured now")


def _fastest(figures_ms: Mapping[str, float], origin: str) -> Choice:
    """Of those hardly slower than the fastest, the one that suffers least from busy neighbours."""
    figures = ", ".join(f"{name} {ms:.1f} ms" for name, ms in sorted(figures_ms.items(), key=itemgetter(1)))
    enough_ms = _HARDLY_SLOWER * min(figures_ms.values())
    chosen = next(name for name in _PATIENT_FIRST if figures_ms.get(name, math.inf) <= enough_ms)
    return Choice(chosen, f"{figures}; {origin}")


def _key(model: Model, installed: list[str], frame_hw: tuple[int, int]) -> str:
    """A name for all that the speed depends on; the values of the weights are not among it."""
    packages = sorted({package for runtime in installed for package in REQUIREMENTS[runtime]})
    circumstances = [
        repr(model.architecture),
        frame_hw,
        [installed_build(package) for package in packages],
        processor(),
        torch.get_num_threads(),
    ]
    return hashlib.sha256(json.dumps(circumstances).encode()).hexdigest()[:16]
