"""Speed measurement of the runtimes."""

from __future__ import annotations

import logging
import statistics
import time
from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.registry import RuntimeAbsentError, load_runtime
from yolov5_lifecycle.runtimes.runtime import InferenceError, Runtime

_ROUNDS = 9
_NOTHING_FOUND = 1.0  # as min_objectness: detections in a grey image must not affect the timing
_ENOUGH_S = 2.0  # large networks are measured in fewer rounds


def measure_ms(
    model: Model, runtimes: Iterable[str], *, precision: str, frame_hw: tuple[int, int]
) -> dict[str, float]:
    """Median milliseconds per frame of `frame_hw` on the CPU, by runtime.

    A runtime that cannot be loaded or run is skipped with a warning; torch raises InferenceError.
    """
    frame = np.full((*frame_hw, 3), 114, np.uint8)
    warm = {name: _warm_runtime(model, name, precision, frame) for name in runtimes}
    running = {name: runtime for name, runtime in warm.items() if runtime is not None}
    taken_ms = _take_turns(running, frame)
    for runtime in running.values():
        runtime.close()
    return taken_ms


def _warm_runtime(model: Model, name: str, precision: str, frame: NDArray[np.uint8]) -> Runtime | None:
    try:
        runtime = load_runtime(model, name, device="cpu", precision=precision)
        for _ in range(2):
            runtime(frame, "rgb", _NOTHING_FOUND)
    except (InferenceError, RuntimeAbsentError) as error:
        if name == "torch":
            raise
        logging.getLogger(__name__).warning("Runtime '%s' is left out: %s", name, error)
        return None
    return runtime


def _take_turns(runtimes: Mapping[str, Runtime], frame: NDArray[np.uint8]) -> dict[str, float]:
    """Median milliseconds by runtime, measured in turns so that machine load affects all equally."""
    seconds: dict[str, list[float]] = {name: [] for name in runtimes}
    begin = time.perf_counter()
    for _ in range(_ROUNDS):
        for name, runtime in runtimes.items():
            before = time.perf_counter()
            runtime(frame, "rgb", _NOTHING_FOUND)
            seconds[name].append(time.perf_counter() - before)
        if time.perf_counter() - begin > _ENOUGH_S:
            break
    return {name: round(1e3 * statistics.median(taken), 2) for name, taken in seconds.items()}
