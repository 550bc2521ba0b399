"""The real detector with the real model; a picture that is one grey all over makes inference fail.

Runs as a process of its own. Which grey has which fault: `GREYS`.
"""

from __future__ import annotations

import sys
import time

from yolov5_lifecycle.heap import prepare_heap

if __name__ == "__main__":
    prepare_heap()  # as the installed command does, before the imports below begin threads

import numpy as np
import torch
from numpy.typing import NDArray

from yolov5_lifecycle.images import Order
from yolov5_lifecycle.preparation import PreparedModel, prepare_model
from yolov5_lifecycle.ros.detector import main
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, Runtime
from yolov5_lifecycle.settings import Settings

Raw = NDArray[np.float32]
SLOW_S = 0.5
HANG_S = 30.0


def fail(raw: Raw) -> Raw:
    raise RuntimeError("a fault on purpose")


def run_out_of_memory(raw: Raw) -> Raw:
    raise torch.OutOfMemoryError("CUDA out of memory, on purpose")


def lose_device(raw: Raw) -> Raw:
    raise DeviceLostError("the GPU has fallen off the bus, on purpose")


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
    "device lost": lose_device,
}
GREYS = {fault: grey for grey, fault in enumerate(FAULTS, start=1)}
_FAULT_OF_GREY = {GREYS[name]: fault for name, fault in FAULTS.items()}


class FaultyRuntime:
    """`runtime`, with the fault that the picture asks for."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self.name = runtime.name
        self.device = runtime.device
        self.precision = runtime.precision

    def __call__(self, frame: NDArray[np.uint8], order: Order, least_objectness: float = 0.0) -> Raw:
        raw = self._runtime(frame, order, least_objectness)
        height, width, _ = frame.shape
        middle = frame[height // 3 : -height // 3, width // 3 : -width // 3]  # without the letterbox's grey
        fault = _FAULT_OF_GREY.get(int(middle[0, 0, 0]))
        return fault(raw) if fault is not None and (middle == middle[0, 0, 0]).all() else raw

    def close(self) -> None:
        self._runtime.close()


def prepare(settings: Settings, source_hw: tuple[int, int]) -> PreparedModel:
    model = prepare_model(settings, source_hw)
    model.detector.runtime = FaultyRuntime(model.detector.runtime)
    return model


if __name__ == "__main__":
    main(["detector", *sys.argv[1:]], prepare=prepare)
