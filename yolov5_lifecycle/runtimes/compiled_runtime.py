"""Runtime of the ONNX engines, which compile the network for each input size."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.cache_folder import cache_folder
from yolov5_lifecycle.runtimes.compiled_store import CompiledStore
from yolov5_lifecycle.runtimes.compiler import Compiler, Engine, Run
from yolov5_lifecycle.runtimes.networks_by_size import NetworksBySize
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.runtimes.sparse_head import DetectionHead
from yolov5_lifecycle.runtimes.torch_device import DeviceError, resolve_precision

_PLANES = {"rgb": (0, 1, 2), "bgr": (2, 1, 0)}


class CompiledRuntime:
    """A network on the CPU in fp32. See `Runtime`."""

    device = "cpu"
    precision = "fp32"

    def __init__(self, compiler: Compiler, engine: Engine) -> None:
        self._engine = engine
        self._compiled = NetworksBySize(
            lambda size_hw: _Compiled(compiler.run(size_hw), compiler.head, size_hw)
        )

    @classmethod
    def load(cls, model: Model, engine: Engine, *, device: str, precision: str) -> CompiledRuntime:
        """Load `model`; raises DeviceError for a device or precision that the engine does not support."""
        if device not in ("auto", "cpu"):
            raise DeviceError(
                f"Runtime '{engine.name}' runs on the CPU only, found device {device[:40]!r}. "
                "Use device 'cpu' or runtime 'torch'."
            )
        resolve_precision(precision, torch.device("cpu"))
        return cls(Compiler(model, engine, CompiledStore(cache_folder("compiled"))), engine)

    @property
    def name(self) -> str:
        return self._engine.name

    def __call__(
        self, frame: NDArray[np.uint8], order: Order, min_objectness: float = 0.0
    ) -> NDArray[np.float32]:
        """See `Runtime`; the first frame of each size waits for the compiler."""
        height, width, _ = frame.shape
        try:
            # Denormal floats are zero in this thread; the engine sees to its own threads.
            with self._compiled.running((height, width)) as compiled:
                return compiled(frame, order, min_objectness)
        except InferenceError:  # it was closed
            raise
        except self._engine.errors as error:
            problem = str(error).partition("\n")[0]
        raise InferenceError(f"{self.name} failed on {self.device}: {problem}")

    def close(self) -> None:
        """See `Runtime`."""
        self._compiled.close()


class _Compiled:
    """A compiled network for one input size, with its detection head and input buffer."""

    def __init__(self, run: Run, head: DetectionHead, size_hw: tuple[int, int]) -> None:
        self._run = run
        self._head = head
        self._planes = np.empty((1, 3, *size_hw), np.uint8)

    def __call__(self, frame: NDArray[np.uint8], order: Order, min_objectness: float) -> NDArray[np.float32]:
        cv2.split(frame, [self._planes[0, plane] for plane in _PLANES[order]])  # written in place
        return self._head(self._run(self._planes), min_objectness)
