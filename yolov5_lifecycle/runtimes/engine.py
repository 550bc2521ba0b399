"""What a library that compiles networks for the CPU is asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.runtimes.detection_head import Features

Run = Callable[[NDArray[np.uint8]], Sequence[Features]]
"""Planes (1, 3, h, w) RGB -> the features of each level, which the next run may overwrite."""


@dataclass(frozen=True)
class Engine:
    """An engine, called like its package; what it does may raise `errors`.

    `build` makes a serialized ONNX model runnable and says what to keep of it, if anything; `restore` makes
    that runnable.
    """

    name: str
    build: Callable[[bytes], tuple[Run, bytes]]
    restore: Callable[[bytes], Run]
    errors: tuple[type[Exception], ...]
