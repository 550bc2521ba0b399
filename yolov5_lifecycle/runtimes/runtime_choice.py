"""The runtime that `auto` stands for: the fastest one that is installed, measured once and cached."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeGuard

import torch

from yolov5_lifecycle.atomic_file import atomic_write, remove_abandoned_folders
from yolov5_lifecycle.input_file import read_regular_file
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.processor import processor
from yolov5_lifecycle.runtimes.registry import (
    COARSE,
    COARSE_RUNTIME,
    REQUIREMENTS,
    installed_build,
    installed_runtimes,
)
from yolov5_lifecycle.runtimes.speed import measure_ms
from yolov5_lifecycle.runtimes.torch_device import resolve_device, resolve_precision

MAX_CACHE_BYTES = 1 << 20
# Next to one busy process, OpenVINO, up to 6 % faster alone, took 8 to 38 % longer than ONNX Runtime.
_PATIENT_FIRST = ("onnxruntime", "openvino", "torch")
_HARDLY_SLOWER = 1.15
_NO_PLACE = (OSError, RuntimeError)  # a cache that cannot be used; RuntimeError when there is no home folder
_log = logging.getLogger(__name__)


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
    measure: Callable[..., dict[str, float]] | None = None,
) -> Choice:
    """The runtime for `auto`: torch on a GPU; on a CPU the fastest at input size `frame_hw` in fp32.

    Results are cached in `folder` (default: the user's cache), so each combination of architecture, input
    size, installed packages and CPU is measured once; a record that is missing or damaged is replaced. Raises
    DeviceError.
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
    path = (folder or cache_folder()) / _key(model, installed, frame_hw)
    if _are_figures(figures_ms := _cached(path), installed):
        return _fastest(figures_ms, f"cached in {path}")
    figures_ms = (measure or measure_ms)(model, installed, precision=precision, frame_hw=frame_hw)
    try:
        _cache(path, figures_ms)
    except _NO_PLACE as error:
        remedy = (
            "Give this user the right to write it, or set XDG_CACHE_HOME: else each start measures again."
        )
        _log.warning("Not cached in %s: %s. %s", path.parent, error, remedy)
    return _fastest(figures_ms, "measured now")


def _are_figures(found: object, installed: list[str]) -> TypeGuard[dict[str, float]]:
    """Whether `found` is what `measure_ms` gives: milliseconds of runtimes, of which torch is always one."""
    return (
        isinstance(found, dict)
        and "torch" in found
        and found.keys() <= set(installed)
        and all(isinstance(ms, float) and 0 <= ms < math.inf for ms in found.values())
    )


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
    return hashlib.sha256(json.dumps(circumstances).encode()).hexdigest()


def cache_folder() -> Path:
    """$XDG_CACHE_HOME/yolov5_lifecycle/choices, default ~/.cache; ~ is not expanded."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(cache if Path(cache).is_absolute() else "~/.cache")
    return root / "yolov5_lifecycle" / "choices"


def _cache(path: Path, figures_ms: Mapping[str, float]) -> None:
    """Write them as JSON, creating the folder if needed; `path` may begin with ~. Raises _NO_PLACE.

    Removes what processes that were killed while writing there left unfinished.
    """
    path = path.expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_abandoned_folders(path.parent)
    atomic_write(path, json.dumps(figures_ms).encode(), is_durable=False)


def _cached(path: Path) -> Any:
    """What was written at `path`, which may begin with ~; None if it is missing or damaged."""
    try:
        return json.loads(read_regular_file(path.expanduser(), MAX_CACHE_BYTES))
    except (*_NO_PLACE, ValueError):
        return None
