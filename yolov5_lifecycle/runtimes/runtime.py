"""Interface of the inference runtimes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ChannelOrder


class InferenceError(RuntimeError):
    """Inference on an image failed or returned invalid predictions."""


class DeviceLostError(InferenceError):
    """The device is lost: only a new process can use it again."""


@dataclass(frozen=True, eq=False)
class Predictions:
    """Output of the network for one frame."""

    rows: NDArray[np.float32]
    """(n, 5 + C + M): rows of `Network.predictions`."""
    compute_prototypes: Callable[[], NDArray[np.float32]] | None = None
    """Prototypes of masks, (M, h, w) for the whole frame; None for a network that does not segment.

    Computed when called, which must happen before the next run. Raises InferenceError.
    """
    compute_embedding: Callable[[], NDArray[np.float32]] | None = None
    """What the whole frame looks like, (C,): the features of the coarsest level, their mean over all cells.

    Computed as the prototypes are; (0,) for an export to ONNX, whose features are not its outputs. None for a
    runtime without one, such as a test's.
    """


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
        """The resolved precision: fp32, fp16, bf16 or int8."""

    def __call__(
        self, frame: NDArray[np.uint8], channel_order: ChannelOrder, min_objectness: float = 0.0
    ) -> Predictions:
        """Raw predictions for a letterboxed frame.

        The frame has the shape (h, w, 3), or (h, w) if its order is grey; it is converted to the channels
        that the network reads.

        Their rows, in the order of the network, are all those whose objectness is not below `min_objectness`,
        in [0, 1], up to rounding; which others are returned depends on the runtime. Raises InferenceError.
        """

    def streams(self, count: int, threads: int) -> Sequence[Runtime]:
        """The same network for `count` threads at the same time, each of which uses `threads` processors.

        They have buffers of their own, and share the weights, with this one only in torch. The caller closes
        them all. Raises InferenceError after `close`, DeviceError on a device that serves one at a time.
        """

    def close(self) -> None:
        """Free the network; later calls raise InferenceError. Idempotent."""
