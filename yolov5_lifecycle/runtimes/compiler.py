"""Compilation of a network by an ONNX engine, for each input shape, with a cache on disk."""

from __future__ import annotations

import hashlib
import logging
import pkgutil
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle import models, runtimes
from yolov5_lifecycle.models.head import Segment
from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import fuse
from yolov5_lifecycle.runtimes.cache import CompiledStore, installed_build, processor
from yolov5_lifecycle.runtimes.networks_by_shape import Shape
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph, prototype_graph
from yolov5_lifecycle.runtimes.quantization import Quantization, convolutions
from yolov5_lifecycle.runtimes.sparse_head import DetectionHead, Features

_GRAPH_MAKERS = tuple(
    f"{package.__name__}.{module.name}"
    for package in (models, runtimes)
    for module in pkgutil.iter_modules(package.__path__)
    if package is models or module.name.startswith("onnx_") or module.name == "quantization"
)
"""Modules on which the ONNX graph of a model depends."""

_log = logging.getLogger(__name__)


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

    def network(self, shape: Shape, threads: Threads) -> Loaded:
        """The compiled network for frames of `shape`; raises the engine's errors."""
        return self._compiled(
            str(shape), lambda: onnx_graph(self._network, shape, self._quantization), threads
        )

    def prototypes(self, shape: tuple[int, int, int, int], threads: Threads) -> Loaded:
        """The compiled `proto` for features of the finest level of `shape`; raises the engine's errors."""
        proto = self.proto
        assert proto is not None
        return self._compiled(f"prototypes {shape}", lambda: prototype_graph(proto, shape), threads)

    def _compiled(self, part: str, graph: Callable[[], bytes], threads: Threads) -> Loaded:
        key = hashlib.sha256(f"{self._identity} {part}".encode()).hexdigest()
        kept = self._store.read(key)
        if kept is not None:
            try:
                return self._engine.restore(kept, threads)
            except self._engine.errors as error:
                _log.warning("Compiling the model again, because the cached one cannot be loaded: %s", error)
        with self._fusing:
            fuse(self._network)
        loaded, content = self._engine.build(graph(), threads)
        if content:
            self._store.keep(key, content)
        return loaded


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
class Threads:
    """Threads of the processor that a compiled network uses for each of the runs that are made at once."""

    each: int
    at_once: int = 1


@dataclass(frozen=True, eq=False)
class Loaded:
    """A network in memory; `new_run` creates a run for one thread at a time, with buffers of its own.

    Runs of one `Loaded` share its weights. Its `Threads` are for them together.
    """

    new_run: Callable[[], Run]


@dataclass(frozen=True)
class Engine:
    """An inference engine, named like its package; `build` and `restore` may raise `errors`.

    `build` compiles a serialized ONNX model and also returns the bytes to cache, empty for none; `restore`
    loads those bytes. They do not depend on the threads.
    """

    name: str
    build: Callable[[bytes, Threads], tuple[Loaded, bytes]]
    restore: Callable[[bytes, Threads], Loaded]
    errors: tuple[type[Exception], ...]
    precision: str = "fp32"
