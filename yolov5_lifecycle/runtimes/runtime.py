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

    def __call__(
        self, frame: NDArray[np.uint8], order: Order, least_objectness: float = 0.0
    ) -> NDArray[np.float32]:
        """Raw predictions (n, 5 + C) for a letterboxed frame (h, w, 3): rows of `Network.forward`.

        In its order: all those whose objectness is not below `least_objectness`, which is in [0, 1], up to
        rounding; which others are given depends on the runtime. Raises InferenceError.
        """

    def close(self) -> None:
        """Free the network; running it then raises InferenceError. Closing again does nothing."""
