"""The real detector with the real model; a uniformly grey image makes inference fail.

Runs as a separate process. The grey value selects the fault: `GREYS`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
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
from yolov5_lifecycle.images.image import ChannelOrder
from yolov5_lifecycle.ros.detector.command import main
from yolov5_lifecycle.runtimes.runtime import Predictions, Runtime
from yolov5_lifecycle.settings.settings import Settings

Raw = NDArray[np.float32]
SLOW_S = 0.5
HANG_S = 10.0
"""Deactivate waits 3 s for each hang, so at most three abandoned threads are alive, the allowed maximum."""


def _raise(error: Exception) -> Raw:
    raise error


def _late(raw: Raw, delay_s: float) -> Raw:
    time.sleep(delay_s)
    return raw


FAULTS: dict[str, Callable[[Raw], Raw]] = {
    "raise": lambda _: _raise(RuntimeError("a fault on purpose")),
    "out of memory": lambda _: _raise(torch.OutOfMemoryError("CUDA out of memory, on purpose")),
    "NaN": lambda raw: np.full((1, raw.shape[1]), np.nan, raw.dtype),
    "wrong shape": lambda raw: raw[:, :-1],
    "slow": lambda raw: _late(raw, SLOW_S),
    "hang": lambda raw: _late(raw, HANG_S),
}
GREYS = {fault: grey for grey, fault in enumerate(FAULTS, start=1)}


class FaultyRuntime:
    """`runtime` with the fault selected by the image."""

    def __init__(self, runtime: Runtime) -> None:
        self._runtime = runtime
        self.name = runtime.name
        self.device = runtime.device
        self.precision = runtime.precision

    def __call__(
        self, frame: NDArray[np.uint8], channel_order: ChannelOrder, min_objectness: float = 0.0
    ) -> Predictions:
        return _with_fault(frame, self._runtime(frame, channel_order, min_objectness))

    def streams(self, count: int, threads: int) -> list[FaultyRuntime]:
        return [FaultyRuntime(stream) for stream in self._runtime.streams(count, threads)]

    def close(self) -> None:
        self._runtime.close()


def _with_fault(frame: NDArray[np.uint8], predictions: Predictions) -> Predictions:
    """The `predictions` with the fault that `frame` selects."""
    height, width = frame.shape[:2]  # a grey frame has no third dimension
    middle = frame[height // 3 : -height // 3, width // 3 : -width // 3]  # without letterbox padding
    grey = int(middle.flat[0])
    chosen = [fault for name, fault in FAULTS.items() if GREYS[name] == grey and (middle == grey).all()]
    return replace(predictions, rows=chosen[0](predictions.rows)) if chosen else predictions


def prepare(settings: Settings, sizes_hw: Sequence[tuple[int, int]]) -> PreparedModel:
    model = prepare_model(settings, sizes_hw)
    model.detector.runtime = FaultyRuntime(model.detector.runtime)
    return model


if __name__ == "__main__":
    main(["detector", *sys.argv[1:]], prepare=prepare)
