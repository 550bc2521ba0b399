"""The network compiled for each size of frame by an engine that reads ONNX."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from yolov5_lifecycle.images import Order
from yolov5_lifecycle.model import Model
from yolov5_lifecycle.network import Detect, Network, fuse
from yolov5_lifecycle.runtimes.detection_head import DetectionHead, Features
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.runtimes.size_cache import SizeCache
from yolov5_lifecycle.runtimes.torch_device import DeviceError, resolve_precision

_PLANES = {"rgb": (0, 1, 2), "bgr": (2, 1, 0)}

Run = Callable[[NDArray[np.uint8]], Sequence[Features]]
"""Planes (1, 3, h, w) RGB -> the features of each level, which the next run may overwrite."""


@dataclass(frozen=True)
class Engine:
    """`compile` makes a serialized ONNX model runnable; it and what it makes may raise `errors`."""

    name: str
    compile: Callable[[bytes], Run]
    errors: tuple[type[Exception], ...]


class CompiledRuntime:
    """A network on the CPU in fp32. Takes `network` over and fuses it. See `Runtime`."""

    device = "cpu"
    precision = "fp32"

    def __init__(self, network: Network, engine: Engine) -> None:
        fuse(network)
        self._engine = engine
        self._compiled: SizeCache[_Compiled] | None = SizeCache(
            lambda size_hw: _Compiled(network, engine, size_hw)
        )

    @classmethod
    def load(cls, model: Model, engine: Engine, *, device: str, precision: str) -> CompiledRuntime:
        """The network of `model`; raises DeviceError for a device or precision that the engine has not."""
        if device not in ("auto", "cpu"):
            raise DeviceError(
                f"Runtime '{engine.name}' runs on the CPU only, found device {device[:40]!r}. "
                "Use device 'cpu' or runtime 'torch'."
            )
        resolve_precision(precision, torch.device("cpu"))
        with torch.device("meta"):  # no time and memory for values that are replaced at once
            network = Network(model.architecture)
        network.load_state_dict(model.state_dict, assign=True)
        return cls(network, engine)

    @property
    def name(self) -> str:
        return self._engine.name

    def __call__(
        self, frame: NDArray[np.uint8], order: Order, least_objectness: float = 0.0
    ) -> NDArray[np.float32]:
        """See `Runtime`; the first frame of a size waits for the compiler."""
        compiled = self._compiled  # a thread that was given up may run while another closes
        if compiled is None:
            raise InferenceError("The runtime was closed; load the model again.")
        try:
            return compiled[frame.shape[0], frame.shape[1]](frame, order, least_objectness)
        except self._engine.errors as error:
            problem = str(error).partition("\n")[0]
        raise InferenceError(f"{self.name} failed on {self.device}: {problem}")

    def close(self) -> None:
        """See `Runtime`."""
        self._compiled = None


class _Compiled:
    """A runnable network for one size, its last layer and its input memory."""

    def __init__(self, network: Network, engine: Engine, size_hw: tuple[int, int]) -> None:
        self._run = engine.compile(onnx_graph(network, size_hw))
        detect = network.model[-1]
        assert isinstance(detect, Detect)
        self._head = DetectionHead(detect)
        self._planes = np.empty((1, 3, *size_hw), np.uint8)

    def __call__(
        self, frame: NDArray[np.uint8], order: Order, least_objectness: float
    ) -> NDArray[np.float32]:
        cv2.split(frame, [self._planes[0, plane] for plane in _PLANES[order]])  # written in place
        return self._head(self._run(self._planes), least_objectness)
