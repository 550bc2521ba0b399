"""Interface of the inference runtimes."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import Order


class InferenceError(RuntimeError):
    """Inference on an image failed or returned invalid predictions."""


class DeviceLostError(InferenceError):
    """The device is lost to this process; only a new process can use it again."""


class Runtime(Protocol):
    """A network on a device, ready to run; for one thread at a time."""

    @property
    def name(self) -> str:
        """The value of the setting `runtime` that selects it."""

    @property
    def device(self) -> str:
        """The resolved device: cpu, cuda:0, ..."""

    @property
    def precision(self) -> str:
        """The resolved precision: fp32 or fp16."""

    def __call__(
        self, frame: NDArray[np.uint8], order: Order, min_objectness: float = 0.0
    ) -> NDArray[np.float32]:
        """Raw predictions (n, 5 + C) for a letterboxed frame: rows of `Network.forward`.

        The frame has the shape (h, w, 3), or (h, w) if its order is grey; whatever it is, the network gets
        the channels that it reads.

        In that order: all rows whose objectness is not below `min_objectness`, in [0, 1], up to rounding;
        which other rows are returned depends on the runtime. Raises InferenceError.
        """

    def run_batch(
        self,
        frames: Sequence[NDArray[np.uint8]],
        orders: Sequence[Order],
        min_objectness: Sequence[float],
    ) -> list[NDArray[np.float32]]:
        """The predictions of each frame, as a call with it alone returns them up to rounding, in one run.

        Raises ValueError unless there is at least one frame, all of one shape, each with an order
        and an objectness; InferenceError when the run fails, for all frames together.
        """

    def keep_batches(self, sizes: Collection[int]) -> None:
        """Free the networks for batches, except for those with a number of frames that is in `sizes`."""

    def close(self) -> None:
        """Free the network; later calls raise InferenceError. Idempotent."""
