"""The detector's `main` with models that behave as its first argument says, and tell when they are closed."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from support.preparations import Preparations
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.ros.detector.command import main
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings.settings import Settings


def lose_device() -> NDArray[np.float32]:
    raise DeviceLostError("the GPU fell off the bus")


def hang() -> NDArray[np.float32]:
    print("hanging", flush=True)  # noqa: T201 - the test reads it
    time.sleep(60)
    raise AssertionError("nobody waits that long")


def tell_of_closing() -> None:
    print("model closed", flush=True)  # noqa: T201 - the test reads it


def prepare_slowly() -> PreparedModel:
    print("loading slowly", flush=True)  # noqa: T201 - the test reads it
    time.sleep(60)
    raise AssertionError("nobody waits that long")


FAULTS = {"lose_device": lose_device, "hang": hang}
PREPARATIONS = Preparations()


def prepare(settings: Settings, sizes_hw: Sequence[tuple[int, int]]) -> PreparedModel:
    fault = sys.argv[1]
    if fault == "load_slowly" or (fault == "reload_slowly" and PREPARATIONS.runtimes):
        return prepare_slowly()
    model = PREPARATIONS(settings, sizes_hw)
    PREPARATIONS.running.on_close = tell_of_closing
    PREPARATIONS.running.run = FAULTS.get(fault, PREPARATIONS.running.run)
    return model


if __name__ == "__main__":
    main(["detector", *sys.argv[2:]], prepare=prepare)
