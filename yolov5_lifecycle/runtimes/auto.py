"""Selection of the fastest installed runtime, measured once and cached."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

import torch

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.cache import (
    NO_PLACE,
    cache_folder,
    installed_build,
    processor,
    read_cache,
    write_cache,
)
from yolov5_lifecycle.runtimes.registry import COARSE, COARSE_RUNTIME, REQUIREMENTS, installed_runtimes
from yolov5_lifecycle.runtimes.speed import measure_ms
from yolov5_lifecycle.runtimes.torch_device import resolve_device, resolve_precision

# Next to one busy process, OpenVINO, up to 6 % faster alone, took 8 to 38 % longer than ONNX Runtime.
_PATIENT_FIRST = ("onnxruntime", "openvino", "torch")
_HARDLY_SLOWER = 1.15
_MAX_RECORD_BYTES = 4096
_MAX_MS = 1e6


@dataclass(frozen=True)
class Choice:
    """A runtime and the reason for choosing it."""

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
    """The runtime for `auto`: torch on a GPU; on a CPU the fastest at input size `frame_hw` in fp32.

    Results are cached in `folder` (default: the user's cache), so each combination of architecture, input
    size, installed packages and CPU is measured once. Raises DeviceError.
    """
    if precision in COARSE:
        return Choice(COARSE_RUNTIME, f"the only one for {precision}")
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
        return _fastest(figures_ms, f"cached in {record}")
    figures_ms = measure(model, installed, precision=precision, frame_hw=frame_hw)
    problem = write_figures(record, figures_ms)
    return _fastest(figures_ms, problem or "measured now")


def _fastest(figures_ms: Mapping[str, float], origin: str) -> Choice:
    """The runtime within 15 % of the fastest that degrades least next to busy processes."""
    figures = ", ".join(f"{name} {ms:.1f} ms" for name, ms in sorted(figures_ms.items(), key=itemgetter(1)))
    enough_ms = _HARDLY_SLOWER * min(figures_ms.values())
    chosen = next(name for name in _PATIENT_FIRST if figures_ms.get(name, math.inf) <= enough_ms)
    return Choice(chosen, f"{figures}; {origin}")


def _key(model: Model, installed: list[str], frame_hw: tuple[int, int]) -> str:
    """Cache key of everything that affects speed; the weight values do not."""
    packages = sorted({"numpy", *(package for runtime in installed for package in REQUIREMENTS[runtime])})
    builds = [installed_build(package) for package in packages]
    circumstances = [repr(model.architecture), frame_hw, builds, processor(), torch.get_num_threads()]
    return hashlib.sha256(json.dumps(circumstances).encode()).hexdigest()[:16]


def read_figures(path: Path, installed: list[str]) -> dict[str, float] | None:
    """Milliseconds by runtime; None if `write_figures` did not write the file.

    Also None for a missing or damaged file, which the next measurement replaces.
    """
    try:
        _, text = read_cache(path, _MAX_RECORD_BYTES) or (b"", b"")
        figures_ms = json.loads(text)
    except (ValueError, RecursionError):
        return None
    usable = isinstance(figures_ms, dict) and "torch" in figures_ms
    if usable and all(name in installed and _is_duration(ms) for name, ms in figures_ms.items()):
        return figures_ms  # type: ignore[no-any-return]
    return None


def write_figures(path: Path, figures_ms: Mapping[str, float]) -> str:
    """Write the file atomically; return the problem, or "" on success."""
    try:
        write_cache(path, json.dumps(figures_ms).encode() + b"\n")
    except NO_PLACE as error:
        return f"measured now, not cached: {error}"
    return ""


def _is_duration(value: object) -> bool:
    return isinstance(value, float) and 0 < value < _MAX_MS
