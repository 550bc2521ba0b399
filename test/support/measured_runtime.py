"""Prints by how many MiB the peak memory of this process grows while it loads and runs a large network.

`python measured_runtime.py RUNTIME`: a process of its own, where no free memory of earlier tests is used.
"""

from __future__ import annotations

import dataclasses
import os
import sys

import numpy as np

from benchmark.process_memory import forget_peak, peak_resident_mb, resident_mb
from support.checkpoint_builder import SMALL
from support.random_model import random_network
from yolov5_lifecycle.models.architecture import Architecture, Layer
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.registry import load_runtime

SIDE_PX = 640
_RUNS = 3


def _layer(kind: str, *args: int, sources: tuple[int, ...] = (-1,)) -> Layer:
    return Layer(sources, 1, kind, args)


LARGE_FEATURES: Architecture = dataclasses.replace(
    SMALL,
    classes=1,
    anchors_px=(((8.0, 8.0), (16.0, 16.0), (32.0, 32.0)),),
    strides=(8,),
    layers=(
        _layer("Conv", 200, 3, 1),
        *[_layer("Conv", 200, 1, 1, sources=(0,))] * 8,
        _layer("Concat", sources=(1, 2, 3, 4)),
        _layer("Conv", 16, 3, 8),
        _layer("Detect", sources=(10,)),
    ),
)
"""Nearly all its memory is features, 424 MB."""


def grown_mb(runtime: str) -> float:
    """By how much the peak memory of this process exceeds that before the network was loaded."""
    state = random_network(0, LARGE_FEATURES).state_dict()
    before_mb = resident_mb(os.getpid())
    forget_peak()
    loaded = load_runtime(Model(LARGE_FEATURES, ("cat",), state), runtime, device="cpu", precision="fp32")
    for _ in range(_RUNS):
        loaded(np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8), "rgb", 0.99)
    return peak_resident_mb(os.getpid()) - before_mb


if __name__ == "__main__":
    sys.stdout.write(f"{grown_mb(sys.argv[1])}\n")
