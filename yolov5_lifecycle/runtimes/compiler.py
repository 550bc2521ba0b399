"""A network made runnable for a size of frame, from what was kept of the last time if possible."""

from __future__ import annotations

import hashlib
import logging
import threading

from yolov5_lifecycle.model import Model
from yolov5_lifecycle.network import Detect, Network, fuse
from yolov5_lifecycle.runtimes.compiled_store import CompiledStore
from yolov5_lifecycle.runtimes.detection_head import DetectionHead
from yolov5_lifecycle.runtimes.engine import Engine, Run
from yolov5_lifecycle.runtimes.machine import installed_build, processor
from yolov5_lifecycle.runtimes.onnx_graph import onnx_graph

_log = logging.getLogger(__name__)


class Compiler:
    """Compiles the network of `model` with `engine`; keeps what comes out in `store`.

    `head` is the network's last layer, which is not compiled.
    """

    def __init__(self, model: Model, engine: Engine, store: CompiledStore) -> None:
        self._network = model.network().requires_grad_(False)
        self._engine = engine
        self._store = store
        self._fusing = threading.Lock()  # a thread that was given up may compile beside its successor
        self._identity = _identity(model, engine)
        detect = self._network.model[-1]
        assert isinstance(detect, Detect)
        self.head = DetectionHead(detect)

    def run(self, size_hw: tuple[int, int]) -> Run:
        """What runs frames of `size_hw`; raises the engine's errors."""
        key = hashlib.sha256(f"{self._identity} {size_hw}".encode()).hexdigest()
        kept = self._store.read(key)
        if kept is not None:
            try:
                return self._engine.restore(kept)
            except self._engine.errors as error:
                _log.warning("A compiled model that was kept cannot be loaded, it is made anew: %s", error)
        with self._fusing:
            fuse(self._network)
        run, content = self._engine.build(onnx_graph(self._network, size_hw))
        if content:
            self._store.keep(key, content)
        return run


def _identity(model: Model, engine: Engine) -> str:
    """A text for all that a compiled model depends on, but the size of frame."""
    weights = hashlib.sha256()
    for name, tensor in sorted(model.state_dict.items()):
        weights.update(name.encode() + tensor.numpy().tobytes())
    makers = (engine.name, engine.build.__module__, onnx_graph.__module__, Network.__module__)
    builds = [installed_build(maker) for maker in makers]
    return repr([builds, processor(), model.architecture, weights.hexdigest()])
