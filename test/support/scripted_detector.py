"""The detector's `main` with models that behave as its first argument says, and tell when they are closed."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from support.preparations import Preparations
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.ros.detector.command import main
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings.settings import Settings


def lose_device() -> NDArray[np.float32]:
    raise DeviceLostError("the GPU fell off the bus")


def tell(words: str) -> None:
    print(words, flush=True)  # noqa: T201 - the test reads it


def hang(words: str) -> NoReturn:
    tell(words)
    time.sleep(60)
    raise AssertionError("nobody waits that long")


FAULTS: dict[str, Callable[[], NDArray[np.float32]]] = {
    "lose_device": lose_device,
    "hang": partial(hang, "hanging"),
}
PREPARATIONS = Preparations()


def prepare(settings: Settings, sizes_hw: Sequence[tuple[int, int]]) -> PreparedModel:
    fault = sys.argv[1]
    if fault == "load_slowly" or (fault == "reload_slowly" and PREPARATIONS.runtimes):
        hang("loading slowly")
    model = PREPARATIONS(settings, sizes_hw)
    PREPARATIONS.running.on_close = partial(tell, "model closed")
    PREPARATIONS.running.run = FAULTS.get(fault, PREPARATIONS.running.run)
    return model


if __name__ == "__main__":
    main(["detector", *sys.argv[2:]], prepare=prepare)
