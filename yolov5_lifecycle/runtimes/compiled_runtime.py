"""Runtime of the ONNX engines, which compile the network for each input shape."""

from __future__ import annotations

import hashlib
import logging
import pkgutil
import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle import models, runtimes
from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import fuse
from yolov5_lifecycle.runtimes.cache import CompiledStore, cache_folder, installed_build, processor
from yolov5_lifecycle.runtimes.networks_by_shape import MIN_KEPT, NetworksByShape, Shape, shape_of_batch
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph, prototype_graph
from yolov5_lifecycle.runtimes.quantization import Quantization, convolutions
from yolov5_lifecycle.runtimes.runtime import InferenceError, Predictions
from yolov5_lifecycle.runtimes.sparse_head import DetectionHead, Features
from yolov5_lifecycle.runtimes.torch_device import DeviceError

_PLANES = {"rgb": (0, 1, 2), "bgr": (2, 1, 0)}
_TO_GREY = {"rgb": cv2.COLOR_RGB2GRAY, "bgr": cv2.COLOR_BGR2GRAY}
_GRAPH_MAKERS = tuple(
    f"{package.__name__}.{module.name}"
    for package in (models, runtimes)
    for module in pkgutil.iter_modules(package.__path__)
    if package is models or module.name.startswith("onnx_") or module.name == "quantization"
)
"""Modules on which the ONNX graph of a model depends."""

Result = TypeVar("Result")
_log = logging.getLogger(__name__)


class CompiledRuntime:
    """A network on the CPU, in fp32 or another precision of `engine`. See `Runtime`."""

    device = "cpu"

    def __init__(self, compiled: NetworksByShape[_Compiled], engine: Engine, *, segments: bool) -> None:
        self.precision = engine.precision
        self._engine = engine
        self._segments = segments
        self._compiled = compiled

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
        if device not in ("auto", "cpu"):
            raise DeviceError(
                f"Runtime '{engine.name}' runs on the CPU only, found device {device[:40]!r}. "
                "Use device 'cpu' or runtime 'torch'."
            )
        store = CompiledStore(cache_folder("compiled"))
        compiler = Compiler(model, engine, store, quantization)
        compiled = NetworksByShape(lambda shape: _Compiled(compiler, shape), kept=kept)
        return cls(compiled, engine, segments=compiler.proto is not None)

    @property
    def name(self) -> str:
        return self._engine.name

    def __call__(self, frame: NDArray[np.uint8], order: Order, min_objectness: float = 0.0) -> Predictions:
        """See `Runtime`; the first frame of each size waits for the compiler."""
        (predictions,) = self.run_batch((frame,), (order,), (min_objectness,))
        return predictions

    def run_batch(
        self,
        frames: Sequence[NDArray[np.uint8]],
        orders: Sequence[Order],
        min_objectness: Sequence[float],
    ) -> list[Predictions]:
        """See `Runtime`; the first batch of each shape waits for the compiler."""
        shape = shape_of_batch(frames, orders, min_objectness)

        def predict(compiled: _Compiled) -> list[Predictions]:
            features = compiled.features(frames, orders)
            of_frames = [[level[index : index + 1] for level in features] for index in range(len(frames))]
            return [
                Predictions(compiled.rows(levels, least), self._prototypes(shape, levels[0]))
                for levels, least in zip(of_frames, min_objectness, strict=True)
            ]

        return self._using(shape, predict)

    def _prototypes(self, shape: Shape, finest: Features) -> Callable[[], NDArray[np.float32]] | None:
        """Computes prototypes from the features of the finest level, (1, channels, ny, nx)."""
        if not self._segments:
            return None
        return lambda: self._using(shape, lambda compiled: compiled.prototypes(finest))

    def _using(self, shape: Shape, use: Callable[[_Compiled], Result]) -> Result:
        """The result of `use` on the network for batches of `shape`; engine errors become InferenceError."""
        try:
            # Denormal floats are zero in this thread; the engine sees to its own threads.
            with self._compiled.running(shape) as compiled:
                return use(compiled)
        except InferenceError:  # it was closed
            raise
        except self._engine.errors as error:
            problem = str(error).partition("\n")[0]
        raise InferenceError(f"{self.name} failed on {self.device}: {problem}")

    def keep_batches(self, sizes: Collection[int]) -> None:
        """See `Runtime`."""
        self._compiled.keep_batches(sizes)

    def twin(self) -> CompiledRuntime:
        """See `Runtime`."""
        return CompiledRuntime(self._compiled.twin(), self._engine, segments=self._segments)

    def close(self) -> None:
        """See `Runtime`."""
        self._compiled.close()


class _Compiled:
    """A compiled network for one input shape, with its input buffer."""

    def __init__(self, compiler: Compiler, shape: Shape) -> None:
        self._compiler = compiler
        self._run = compiler.run(shape)
        self._run_proto: Run | None = None
        batch, height, width = shape
        self._planes = np.empty((batch, compiler.channels, height, width), np.uint8)

    def features(self, frames: Sequence[NDArray[np.uint8]], orders: Sequence[Order]) -> Sequence[Features]:
        """Features of all levels for all frames; the next run may overwrite them."""
        for planes, frame, order in zip(self._planes, frames, orders, strict=True):
            write_planes(frame, order, planes)
        return self._run(self._planes)

    def rows(self, features: Sequence[Features], min_objectness: float) -> NDArray[np.float32]:
        """The predictions for one frame."""
        return self._compiler.head(features, min_objectness)

    def prototypes(self, finest: Features) -> NDArray[np.float32]:
        """Prototypes (M, h, w) from the features of the finest level, for one frame."""
        if self._run_proto is None:
            self._run_proto = self._compiler.prototypes(finest)
        (batch,) = self._run_proto(finest)
        prototypes: NDArray[np.float32] = batch[0].copy()  # the next run may overwrite them
        return prototypes


def write_planes(frame: NDArray[np.uint8], order: Order, planes: NDArray[np.uint8]) -> None:
    """Write a frame (h, w, 3), or (h, w) if it is grey, into `planes`: (3, h, w) RGB or (1, h, w) grey."""
    if order == "grey":
        planes[:] = frame
    elif len(planes) == 1:
        cv2.cvtColor(frame, _TO_GREY[order], dst=planes[0])
    else:
        cv2.split(frame, [planes[plane] for plane in _PLANES[order]])


class Compiler:
    """Compiles the network of `model` with `engine`, in int8 with `quantization`; caches results in `store`.

    `head` is the network's last layer, which is not compiled; `proto` its part that computes mask prototypes,
    None if the network does not segment. Its images have `channels`, 3 or 1.

    Raises QuantizationError if `quantization` belongs to another network.
    """

    def __init__(
        self, model: Model, engine: Engine, store: CompiledStore, quantization: Quantization | None = None
    ) -> None:
        self._network = model.network().requires_grad_(False)
        self._quantization = quantization
        if quantization is not None:
            quantization.check(convolutions(self._network))
        self.channels = model.architecture.image_channels
        self._engine = engine
        self._store = store
        self._fusing = threading.Lock()  # an abandoned thread may compile concurrently with its successor
        self._identity = _identity(model, engine, quantization)
        detect = self._network.head
        self.head = DetectionHead(detect)
        self.proto = detect.proto if isinstance(detect, Segment) else None

    def run(self, shape: Shape) -> Run:
        """The compiled network for batches of `shape`; raises the engine's errors."""
        return self._compiled(str(shape), lambda: onnx_graph(self._network, shape, self._quantization))

    def prototypes(self, finest: Features) -> Run:
        """The compiled `proto` for features like `finest`; raises the engine's errors."""
        proto, shape = self.proto, finest.shape
        assert proto is not None
        return self._compiled(f"prototypes {shape}", lambda: prototype_graph(proto, shape))

    def _compiled(self, part: str, graph: Callable[[], bytes]) -> Run:
        key = hashlib.sha256(f"{self._identity} {part}".encode()).hexdigest()
        kept = self._store.read(key)
        if kept is not None:
            try:
                return self._engine.restore(kept)
            except self._engine.errors as error:
                _log.warning("Compiling the model again, because the cached one cannot be loaded: %s", error)
        with self._fusing:
            fuse(self._network)
        run, content = self._engine.build(graph())
        if content:
            self._store.keep(key, content)
        return run


def _identity(model: Model, engine: Engine, quantization: Quantization | None) -> str:
    """A string of everything except the input shape on which a compiled model depends."""
    weights = hashlib.sha256()
    for name, tensor in sorted(model.state_dict.items()):
        weights.update(name.encode() + tensor.numpy().tobytes())
    makers = (engine.name, engine.build.__module__, *_GRAPH_MAKERS)
    builds = [installed_build(maker) for maker in makers]
    precision = (engine.precision, quantization.digest if quantization else "")
    return repr([builds, processor(), model.architecture, weights.hexdigest(), precision])


Run = Callable[[NDArray[np.generic]], Sequence[Features]]
"""Planes (batch, 3 or 1, h, w), RGB or grey -> features of each level, which the next run may overwrite.

Or features of the finest level (1, channels, ny, nx) -> prototypes (1, M, h, w).
"""


@dataclass(frozen=True)
class Engine:
    """An inference engine, named like its package; `build` and `restore` may raise `errors`.

    `build` compiles a serialized ONNX model and also returns the bytes to cache, empty for none; `restore`
    loads those bytes.
    """

    name: str
    build: Callable[[bytes], tuple[Run, bytes]]
    restore: Callable[[bytes], Run]
    errors: tuple[type[Exception], ...]
    precision: str = "fp32"
