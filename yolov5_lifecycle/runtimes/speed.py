"""Measured speed: of a network whole and in streams; the fastest installed runtime, which is cached."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TypeGuard, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.cache import NO_PLACE, cache_folder, read_cache, write_cache
from yolov5_lifecycle.runtimes.processor import processor
from yolov5_lifecycle.runtimes.registry import (
    COARSE,
    COARSE_RUNTIME,
    REQUIREMENTS,
    installed_build,
    installed_runtimes,
    load_runtime,
)
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime
from yolov5_lifecycle.runtimes.torch_device import DeviceError, resolve_device, resolve_precision

# Next to one busy process, OpenVINO, up to 6 % faster alone, took 8 to 38 % longer than ONNX Runtime.
_PATIENT_FIRST = ("onnxruntime", "openvino", "torch")
_HARDLY_SLOWER = 1.15
_ROUNDS = 9
_WARM_UPS = 2
_NOTHING_FOUND = 1.0  # as min_objectness: detections in a grey image must not affect the timing
_ENOUGH_S = 2.0  # large networks are measured in fewer rounds

Key = TypeVar("Key")
Run = Callable[[], object]
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
    if _are_figures(figures_ms := read_cache(path), installed):
        return _fastest(figures_ms, f"cached in {path}")
    figures_ms = (measure or measure_ms)(model, installed, precision=precision, frame_hw=frame_hw)
    try:
        write_cache(path, figures_ms)
    except NO_PLACE as error:
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


@dataclass(frozen=True)
class Taken:
    """Milliseconds on the clock, and of all processors together in all threads of this process."""

    wall_ms: float
    processor_ms: float


def measure_ms(
    model: Model, runtimes: Iterable[str], *, precision: str, frame_hw: tuple[int, int]
) -> dict[str, float]:
    """Median milliseconds per frame of `frame_hw` on the CPU, by runtime.

    A runtime that cannot be loaded or run is skipped with a warning; torch raises InferenceError.
    """
    frame = _grey(frame_hw)
    warm = {name: _warm_runtime(model, name, precision, frame) for name in runtimes}
    running = {name: runtime for name, runtime in warm.items() if runtime is not None}
    taken = _take_turns(
        {name: partial(runtime, frame, "rgb", _NOTHING_FOUND) for name, runtime in running.items()}
    )
    for runtime in running.values():
        runtime.close()
    return {name: each.wall_ms for name, each in taken.items()}


def measure_streams_ms(
    whole: Runtime, streams: Sequence[Runtime], *, frames_hw: Sequence[tuple[int, int]]
) -> tuple[float, float]:
    """Median milliseconds per frame, the mean of all `frames_hw`: of `whole`, and of all `streams` at once.

    The runtimes are warm. Raises InferenceError.
    """
    frames = [_grey(frame_hw) for frame_hw in frames_hw]

    def run(runtime: Runtime) -> None:
        for frame in frames:
            runtime(frame, "rgb", _NOTHING_FOUND)

    with ThreadPoolExecutor(len(streams)) as threads:
        taken = _take_turns({"whole": partial(run, whole), "streams": lambda: [*threads.map(run, streams)]})
    return taken["whole"].wall_ms / len(frames), taken["streams"].wall_ms / (len(frames) * len(streams))


def _warm_runtime(model: Model, name: str, precision: str, frame: NDArray[np.uint8]) -> Runtime | None:
    try:
        runtime = load_runtime(model, name, device="cpu", precision=precision)
        for _ in range(_WARM_UPS):
            runtime(frame, "rgb", _NOTHING_FOUND)
    except (InferenceError, DeviceError) as error:
        if name == "torch":
            raise
        _log.warning("Runtime '%s' was not measured, because it failed: %s", name, error)
        return None
    return runtime


def _grey(frame_hw: tuple[int, int]) -> NDArray[np.uint8]:
    return np.full((*frame_hw, 3), 114, np.uint8)


def _take_turns(runs: Mapping[Key, Run]) -> dict[Key, Taken]:
    """Medians of each run, measured alternately so that machine load affects all equally."""
    rounds: dict[Key, list[Taken]] = {key: [] for key in runs}
    begin = time.perf_counter()
    for _ in range(_ROUNDS):
        for key, run in runs.items():
            rounds[key].append(time_taken(run))
        if time.perf_counter() - begin > _ENOUGH_S:
            break
    return {key: median(taken) for key, taken in rounds.items()}


def time_taken(run: Run) -> Taken:
    """What `run` takes, once."""
    wall_s, processor_s = time.perf_counter(), time.process_time()
    run()
    return Taken(1e3 * (time.perf_counter() - wall_s), 1e3 * (time.process_time() - processor_s))


def median(taken: Sequence[Taken]) -> Taken:
    """The medians, rounded to 0.01 ms, of at least one."""
    wall_ms = statistics.median(each.wall_ms for each in taken)
    processor_ms = statistics.median(each.processor_ms for each in taken)
    return Taken(round(wall_ms, 2), round(processor_ms, 2))
