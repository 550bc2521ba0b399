"""A runtime of the test's."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import Order


class ScriptedRuntime:
    """Predicts what `run` says, which may be replaced at any time, and raise, wait or answer nonsense.

    `calls` are the shapes of the frames, their orders of colours and the least objectness asked for.
    """

    name = "scripted"
    device = "cpu"
    precision = "fp32"

    def __init__(self, run: Callable[[], NDArray[np.float32]]) -> None:
        self.run = run
        self.on_close: Callable[[], None] = lambda: None
        self.calls: list[tuple[tuple[int, ...], Order, float]] = []
        self.is_closed = False

    def __call__(
        self, frame: NDArray[np.uint8], order: Order, min_objectness: float = 0.0
    ) -> NDArray[np.float32]:
        self.calls.append((frame.shape, order, min_objectness))
        return self.run()

    def close(self) -> None:
        self.is_closed = True
        self.on_close()
