"""Runtime of the ONNX engines, which compile the network for each input shape."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar
from weakref import WeakValueDictionary

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.runtimes.cache import CompiledStore, cache_folder
from yolov5_lifecycle.runtimes.compiler import Compiler, Engine, Loaded, Run, Threads
from yolov5_lifecycle.runtimes.networks_by_shape import (
    MIN_KEPT,
    NetworksByShape,
    Shape,
    closed,
)
from yolov5_lifecycle.runtimes.quantization import Quantization
from yolov5_lifecycle.runtimes.runtime import InferenceError, Predictions
from yolov5_lifecycle.runtimes.sparse_head import Features
from yolov5_lifecycle.runtimes.torch_device import DeviceError

_PLANES = {"rgb": (0, 1, 2), "bgr": (2, 1, 0)}
_TO_GREY = {"rgb": cv2.COLOR_RGB2GRAY, "bgr": cv2.COLOR_BGR2GRAY}

Result = TypeVar("Result")


class CompiledRuntime:
    """A network on the CPU, in fp32 or another precision of `engine`. See `Runtime`."""

    device = "cpu"

    def __init__(self, shared: _Shared, engine: Engine, *, kept: int) -> None:
        self.precision = engine.precision
        self._segments = shared.compiler.proto is not None
        self._engine = engine
        self._kept = kept
        self._shared: _Shared | None = shared
        """None once closed."""
        self._compiled = NetworksByShape(lambda shape: _Compiled(shared, shape), kept=kept)

    @classmethod
    def load(
        cls,
        model: Model,
        engine: Engine,
        *,
        device: str,
        quantization: Quantization | None = None,
        kept: int = MIN_KEPT,
    ) -> CompiledRuntime:
        """Load `model`, in int8 with `quantization`; `kept`: see `NetworksByShape`.

        Raises DeviceError for a device that the engine does not support, and QuantizationError.
        """
        check_processor(device, engine)
        store = CompiledStore(cache_folder("compiled"))
        compiler = Compiler(model, engine, store, quantization)
        return cls(_Shared(compiler, processor_threads()), engine, kept=kept)

    @property
    def name(self) -> str:
        return self._engine.name

    def __call__(self, frame: NDArray[np.uint8], order: Order, min_objectness: float = 0.0) -> Predictions:
        """See `Runtime`; the first frame of each size waits for the compiler."""
        shape = frame.shape[0], frame.shape[1]

        def predict(compiled: _Compiled) -> Predictions:
            features = compiled.features(frame, order)
            return Predictions(
                compiled.rows(features, min_objectness),
                self._prototypes(shape, features[0]),
                partial(_mean, features[-1]),
            )

        return self._using(shape, predict)

    def _prototypes(self, shape: Shape, finest: Features) -> Callable[[], NDArray[np.float32]] | None:
        """Computes prototypes from the features of the finest level, (1, channels, ny, nx)."""
        if not self._segments:
            return None
        return lambda: self._using(shape, lambda compiled: compiled.prototypes(finest))

    def _using(self, shape: Shape, use: Callable[[_Compiled], Result]) -> Result:
        """The result of `use` on the network for frames of `shape`; engine errors become InferenceError."""
        try:
            # Denormal floats are zero in this thread; the engine sees to its own threads.
            with self._compiled.running(shape) as compiled:
                return use(compiled)
        except InferenceError:  # it was closed
            raise
        except self._engine.errors as error:
            problem = str(error).partition("\n")[0]
        raise InferenceError(f"{self.name} failed on {self.device}: {problem}")

    def lanes(self, count: int, threads: int) -> list[CompiledRuntime]:
        """See `Runtime`."""
        shared = _Shared(self._open().compiler, Threads(threads, at_once=count))
        return [CompiledRuntime(shared, self._engine, kept=self._kept) for _ in range(count)]

    def close(self) -> None:
        """See `Runtime`."""
        self._shared = None
        self._compiled.close()

    def _open(self) -> _Shared:
        if (shared := self._shared) is None:
            raise closed()
        return shared


def check_processor(device: str, engine: Engine, *, otherwise: str = "runtime 'torch'") -> None:
    """Raise DeviceError unless `device` is the one that `engine` supports; `otherwise`: what to use then."""
    if device not in ("auto", "cpu"):
        raise DeviceError(
            f"Runtime '{engine.name}' runs on the CPU only, found device {device[:40]!r}. "
            f"Use device 'cpu' or {otherwise}."
        )


def processor_threads() -> Threads:
    """As many as torch uses."""
    return Threads(torch.get_num_threads())


class _Shared:
    """What runtimes for the same `threads` have in common: each network is compiled once for all of them.

    It is freed with the last runtime that uses it.
    """

    def __init__(self, compiler: Compiler, threads: Threads) -> None:
        self.compiler = compiler
        self.threads = threads
        self._loading = threading.Lock()
        self._loaded: WeakValueDictionary[str, Loaded] = WeakValueDictionary()

    def network(self, shape: Shape) -> Loaded:
        """The network for frames of `shape`; raises the engine's errors."""
        return self._one(f"{shape}", lambda: self.compiler.network(shape, self.threads))

    def prototypes(self, finest: Features) -> Loaded:
        """The network's `proto` for features like `finest`; raises the engine's errors."""
        _, channels, height, width = finest.shape
        shape = (1, channels, height, width)
        return self._one(f"prototypes {shape}", lambda: self.compiler.prototypes(shape, self.threads))

    def _one(self, part: str, load: Callable[[], Loaded]) -> Loaded:
        with self._loading:
            found = self._loaded.get(part)
            if found is None:
                found = self._loaded[part] = load()
            return found


class _Compiled:
    """A compiled network for one input shape, with its input buffer."""

    def __init__(self, shared: _Shared, shape: Shape) -> None:
        self._shared = shared
        self._loaded = shared.network(shape)
        self._run = self._loaded.new_run()
        self._loaded_proto: Loaded | None = None
        self._run_proto: Run | None = None
        self._planes = np.empty((1, shared.compiler.channels, *shape), np.uint8)

    def features(self, frame: NDArray[np.uint8], order: Order) -> Sequence[Features]:
        """Features of all levels; the next run may overwrite them."""
        write_planes(frame, order, self._planes[0])
        return self._run(self._planes)

    def rows(self, features: Sequence[Features], min_objectness: float) -> NDArray[np.float32]:
        """The predictions for the frame of `features`."""
        return self._shared.compiler.head(features, min_objectness)

    def prototypes(self, finest: Features) -> NDArray[np.float32]:
        """Prototypes (M, h, w) from the features of the finest level."""
        if self._run_proto is None:
            self._loaded_proto = self._shared.prototypes(finest)
            self._run_proto = self._loaded_proto.new_run()
        (found,) = self._run_proto(finest)
        prototypes: NDArray[np.float32] = found[0].copy()  # the next run may overwrite them
        return prototypes


def _mean(features: Features) -> NDArray[np.float32]:
    """The mean (channels,) over all cells of one frame's features (1, channels, ny, nx)."""
    mean: NDArray[np.float32] = features[0].mean(axis=(1, 2), dtype=np.float32)
    return mean


def write_planes(frame: NDArray[np.uint8], order: Order, planes: NDArray[np.uint8]) -> None:
    """Write a frame (h, w, 3), or (h, w) if it is grey, into `planes`: (3, h, w) RGB or (1, h, w) grey."""
    if order == "grey":
        planes[:] = frame
    elif len(planes) == 1:
        cv2.cvtColor(frame, _TO_GREY[order], dst=planes[0])
    else:
        cv2.split(frame, [planes[plane] for plane in _PLANES[order]])
