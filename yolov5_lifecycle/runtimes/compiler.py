"""Compilation of a network for an input size, from the cache if possible."""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.models.model import Model
from yolov5_lifecycle.models.network import Detect, Network, fuse
from yolov5_lifecycle.runtimes.compiled_store import CompiledStore
from yolov5_lifecycle.runtimes.fingerprint import installed_build, processor
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph
from yolov5_lifecycle.runtimes.sparse_head import DetectionHead, Features

_log = logging.getLogger(__name__)


class Compiler:
    """Compiles the network of `model` with `engine` and caches the result in `store`.

    `head` is the network's last layer, which is not compiled.
    """

    def __init__(self, model: Model, engine: Engine, store: CompiledStore) -> None:
        self._network = model.network().requires_grad_(False)
        self._engine = engine
        self._store = store
        self._fusing = threading.Lock()  # an abandoned thread may compile concurrently with its successor
        self._identity = _identity(model, engine)
        detect = self._network.model[-1]
        assert isinstance(detect, Detect)
        self.head = DetectionHead(detect)

    def run(self, size_hw: tuple[int, int]) -> Run:
        """The compiled network for frames of `size_hw`; raises the engine's errors."""
        key = hashlib.sha256(f"{self._identity} {size_hw}".encode()).hexdigest()
        kept = self._store.read(key)
        if kept is not None:
            try:
                return self._engine.restore(kept)
            except self._engine.errors as error:
                _log.warning("A compiled model that was kept cannot be loaded, it is recompiled: %s", error)
        with self._fusing:
            fuse(self._network)
        run, content = self._engine.build(onnx_graph(self._network, size_hw))
        if content:
            self._store.keep(key, content)
        return run


def _identity(model: Model, engine: Engine) -> str:
    """A string of everything that a compiled model depends on except the input size."""
    weights = hashlib.sha256()
    for name, tensor in sorted(model.state_dict.items()):
        weights.update(name.encode() + tensor.numpy().tobytes())
    makers = (engine.name, engine.build.__module__, onnx_graph.__module__, Network.__module__)
    builds = [installed_build(maker) for maker in makers]
    return repr([builds, processor(), model.architecture, weights.hexdigest()])


Run = Callable[[NDArray[np.uint8]], Sequence[Features]]
"""Planes (1, 3, h, w) RGB -> the features of each level, which the next run may overwrite."""


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
