"""A runtime of the test's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.runtimes.runtime import Predictions


class ScriptedRuntime:
    """Predicts what `run` says, which may be replaced at any time, and raise, wait or answer nonsense.

    `calls` are the shapes of the frames, their orders of colours and the least objectness asked for.
    """

    name = "scripted"
    device = "cpu"
    precision = "fp32"

    def __init__(self, run: Callable[[], NDArray[np.float32]]) -> None:
        self.run = run
        self.compute_prototypes: Callable[[], NDArray[np.float32]] | None = None
        self.on_close: Callable[[], None] = lambda: None
        self.calls: list[tuple[tuple[int, ...], Order, float]] = []
        self.is_closed = False
        self.made_lanes: list[ScriptedRuntime] = []

    def __call__(self, frame: NDArray[np.uint8], order: Order, min_objectness: float = 0.0) -> Predictions:
        self.calls.append((frame.shape, order, min_objectness))
        return Predictions(self.run(), self.compute_prototypes)

    def lanes(self, count: int, threads: int) -> list[ScriptedRuntime]:
        for _ in range(count):
            self.made_lanes.append(lane := ScriptedRuntime(self.run))
            lane.on_close = self.on_close
        return self.made_lanes[-count:] if count else []

    def close(self) -> None:
        self.is_closed = True
        self.on_close()
