"""A runtime of the test's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ChannelOrder
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
        self.calls: list[tuple[tuple[int, ...], ChannelOrder, float]] = []
        self.is_closed = False
        self.made_streams: list[ScriptedRuntime] = []

    def __call__(
        self, frame: NDArray[np.uint8], channel_order: ChannelOrder, min_objectness: float = 0.0
    ) -> Predictions:
        self.calls.append((frame.shape, channel_order, min_objectness))
        return Predictions(self.run(), self.compute_prototypes)

    def streams(self, count: int, threads: int) -> list[ScriptedRuntime]:
        for _ in range(count):
            self.made_streams.append(stream := ScriptedRuntime(self.run))
            stream.on_close = self.on_close
        return self.made_streams[-count:] if count else []

    def close(self) -> None:
        self.is_closed = True
        self.on_close()
