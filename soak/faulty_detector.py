"""The real detector with the real model; a uniformly grey image makes inference fail.

Runs as a separate process. The grey value selects the fault: `GREYS`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace

from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.memory import prepare_heap

if __name__ == "__main__":
    prepare_environment()
    prepare_heap()  # as in the installed command, before the imports below start threads

import numpy as np
import torch
from numpy.typing import NDArray

from yolov5_lifecycle.detection.prepared_model import PreparedModel, prepare_model
from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.ros.detector.command import main
from yolov5_lifecycle.runtimes.runtime import Predictions, Runtime
from yolov5_lifecycle.settings.settings import Settings

Raw = NDArray[np.float32]
SLOW_S = 0.5
HANG_S = 10.0
"""Deactivate waits 3 s for each hang, so at most three abandoned threads are alive, the allowed maximum."""


def fail(raw: Raw) -> Raw:
    raise RuntimeError("a fault on purpose")


def run_out_of_memory(raw: Raw) -> Raw:
    raise torch.OutOfMemoryError("CUDA out of memory, on purpose")


def give_nan(raw: Raw) -> Raw:
    return np.full((1, raw.shape[1]), np.nan, raw.dtype)


def give_wrong_shape(raw: Raw) -> Raw:
    return raw[:, :-1]


def be_slow(raw: Raw) -> Raw:
    time.sleep(SLOW_S)
    return raw


def hang(raw: Raw) -> Raw:
    time.sleep(HANG_S)
    return raw


FAULTS = {
    "raise": fail,
    "out of memory": run_out_of_memory,
    "NaN": give_nan,
    "wrong shape": give_wrong_shape,
    "slow": be_slow,
    "hang": hang,
}
GREYS = {fault: grey for grey, fault in enumerate(FAULTS, start=1)}
_FAULT_OF_GREY = {GREYS[name]: fault for name, fault in FAULTS.items()}


class FaultyRuntime:
    """`runtime` with the fault selected by the image."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self.name = runtime.name
        self.device = runtime.device
        self.precision = runtime.precision

    def __call__(self, frame: NDArray[np.uint8], order: Order, min_objectness: float = 0.0) -> Predictions:
        return _with_fault(frame, self._runtime(frame, order, min_objectness))

    def lanes(self, count: int, threads: int) -> list[FaultyRuntime]:
        return [FaultyRuntime(lane) for lane in self._runtime.lanes(count, threads)]

    def close(self) -> None:
        self._runtime.close()


def _with_fault(frame: NDArray[np.uint8], predictions: Predictions) -> Predictions:
    """The `predictions` with the fault that `frame` selects."""
    height, width = frame.shape[:2]  # a grey frame has no third dimension
    middle = frame[height // 3 : -height // 3, width // 3 : -width // 3]  # without letterbox padding
    grey = int(middle.flat[0])
    fault = _FAULT_OF_GREY.get(grey)
    if fault is None or not (middle == grey).all():
        return predictions
    return replace(predictions, rows=fault(predictions.rows))


def prepare(settings: Settings, sizes_hw: Sequence[tuple[int, int]]) -> PreparedModel:
    model = prepare_model(settings, sizes_hw)
    model.detector.runtime = FaultyRuntime(model.detector.runtime)
    return model


if __name__ == "__main__":
    main(["detector", *sys.argv[1:]], prepare=prepare)
