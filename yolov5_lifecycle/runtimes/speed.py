"""Measured speed of networks: in each runtime, and whole beside in streams."""

from __future__ import annotations

import logging
import statistics
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.registry import load_runtime
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime
from yolov5_lifecycle.runtimes.torch_device import DeviceError

_ROUNDS = 9
_WARM_UPS = 2
_NOTHING_FOUND = 1.0  # as min_objectness: detections in a grey image must not affect the timing
_ENOUGH_S = 2.0  # large networks are measured in fewer rounds

Key = TypeVar("Key")
Run = Callable[[], object]
_log = logging.getLogger(__name__)


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
