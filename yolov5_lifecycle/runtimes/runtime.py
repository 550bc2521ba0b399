"""The call that every way to execute a network answers."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images import Order


class InferenceError(RuntimeError):
    """The network could not be run on a picture, or gave no usable predictions."""


class DeviceLostError(InferenceError):
    """The device will not answer this process again; only a new process helps."""


class Runtime(Protocol):
    """A network on a device, ready to run; for one thread at a time."""

    @property
    def name(self) -> str:
        """The word of the setting `runtime` that chooses it."""

    @property
    def device(self) -> str:
        """Where it really runs: cpu, cuda:0, ..."""

    @property
    def precision(self) -> str:
        """What it really computes in: fp32 or fp16."""

    def __call__(self, frame: NDArray[np.uint8], order: Order) -> NDArray[np.float32]:
        """Raw predictions (N, 5 + C), see `Network`, for a letterboxed frame (h, w, 3).

        Raises InferenceError.
        """

    def close(self) -> None:
        """Free the network; running it then raises InferenceError. Closing again does nothing."""
