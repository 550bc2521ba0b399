"""The call that every way to execute a network answers."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images import Order


class InferenceError(RuntimeError):
    """The network could not be run on a picture, or gave no usable predictions."""


class Runtime(Protocol):
    """A network on a device, ready to run. Not for two threads at once."""

    @property
    def name(self) -> str:
        """As in the setting `runtime`: torch, ..."""

    @property
    def device(self) -> str:
        """Where it really runs: cpu, cuda:0, ..."""

    @property
    def precision(self) -> str:
        """fp32 or fp16."""

    def __call__(self, frame: NDArray[np.uint8], order: Order) -> NDArray[np.float32]:
        """Raw predictions (N, 5 + C) as of `Network` for a letterboxed frame (h, w, 3) with colours in `order`.

        Raises InferenceError.
        """

    def close(self) -> None:
        """Free the network; a call afterwards raises InferenceError. Closing again does nothing."""
