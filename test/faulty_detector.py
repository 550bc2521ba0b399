"""The installed detector's `main` with a runtime that fails as its first argument says."""

from __future__ import annotations

import sys
import time

import numpy as np
from numpy.typing import NDArray
from served_node import Preparations

from yolov5_lifecycle.ros.detector import main
from yolov5_lifecycle.ros.preparation import PreparedModel
from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.settings import Settings


def lose_device() -> NDArray[np.float32]:
    raise DeviceLostError("the GPU has fallen off the bus")


def hang() -> NDArray[np.float32]:
    print("hanging", flush=True)  # noqa: T201 - the test reads it
    time.sleep(60)
    raise AssertionError("nobody waits that long")


def prepare_slowly(settings: Settings) -> PreparedModel:
    time.sleep(60)
    raise AssertionError("nobody waits that long")


FAULTS = {"lose_device": lose_device, "hang": hang}


def prepare(settings: Settings) -> PreparedModel:
    if sys.argv[1] == "load_slowly":
        return prepare_slowly(settings)
    preparations = Preparations()
    model = preparations(settings)
    preparations.running.run = FAULTS[sys.argv[1]]
    return model


if __name__ == "__main__":
    main(["detector", *sys.argv[2:]], prepare=prepare)
