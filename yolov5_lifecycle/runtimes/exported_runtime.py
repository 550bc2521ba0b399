"""Runtime of an export to ONNX, whose graph an engine runs as it is."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ChannelOrder
from yolov5_lifecycle.models.model import Export
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.runtimes.compiled_runtime import (
    CompiledRuntime,
    Engine,
    Loaded,
    Program,
    Threads,
    check_processor,
    write_planes,
)
from yolov5_lifecycle.runtimes.networks_by_shape import Shape, denormals_as_zero
from yolov5_lifecycle.runtimes.runtime import InferenceError, Predictions


def load_exported(export: Export, engine: Engine, *, device: str) -> CompiledRuntime:
    """Load `export` as it is; raises DeviceError for a device that the engine does not support.

    Raises InferenceError if the engine cannot load it.
    """
    check_processor(device, engine, otherwise="the .pt and runtime 'torch'")
    threads = Threads()
    try:
        with denormals_as_zero():  # the engine leaves this thread in that mode
            program = _Exported(export, engine, threads)
    except engine.errors as error:
        problem = in_one_line(str(error))
    else:
        return CompiledRuntime(program, threads)
    raise InferenceError(f"{engine.name} cannot load this export: {problem}")


class _Exported(Program):
    """The graph of `export`.

    Embeddings are empty. Rows of an export without objectness have 1 there, and those whose best class scores
    below the least objectness that is asked for are left out.
    """

    def __init__(self, export: Export, engine: Engine, threads: Threads) -> None:
        super().__init__(engine, export.precision)
        self._export = export
        self._first = self._loaded_for(threads)
        """Loaded at once, so that a graph that cannot be is refused."""

    def network(self, shape: Shape, threads: Threads) -> _ExportedNetwork:
        """See `Program`."""
        return _ExportedNetwork(self._export, self._loaded_for(threads), shape)

    def _loaded_for(self, threads: Threads) -> Loaded:
        return self.shared("graph", threads, lambda: self._export.graph)


class _ExportedNetwork:
    """A loaded `export` for one input shape, with its input buffer.

    A fixed batch is filled up with black.
    """

    def __init__(self, export: Export, loaded: Loaded, shape: Shape) -> None:
        self._export = export
        self._loaded = loaded
        self._run = loaded()
        self._planes = np.zeros((export.batch or 1, export.channels, *shape), np.uint8)

    def __call__(
        self, frame: NDArray[np.uint8], channel_order: ChannelOrder, min_objectness: float
    ) -> Predictions:
        """See `Runtime`."""
        export = self._export
        write_planes(frame, channel_order, self._planes[0])
        pixels = np.multiply(self._planes, 1 / 255, dtype=np.float32)
        outputs = self._run(pixels.astype(np.float16) if export.is_half else pixels)
        rows = _likely_rows(np.asarray(outputs[export.boxes], np.float32)[0], export, min_objectness)
        _check_meaning(rows, export)
        compute_prototypes = None
        if export.prototypes is not None:  # copied: the next run may overwrite them
            compute_prototypes = partial(np.asarray, np.array(outputs[export.prototypes][0], np.float32))
        return Predictions(rows, compute_prototypes, _empty)


def _empty() -> NDArray[np.float32]:
    return np.empty(0, np.float32)


def _likely_rows(boxes: NDArray[np.float32], export: Export, least: float) -> NDArray[np.float32]:
    """Rows (n, 5 + C + M) of one image from `boxes`, (N, 5 + C + M) or without objectness (4 + C + M, N)."""
    if export.has_objectness:
        return boxes[~(boxes[:, 4] < least)]  # NaN is not below: the caller checks the rows
    best = boxes[4 : 4 + len(export.class_names)].max(axis=0)
    likely = boxes[:, ~(best < least)].T
    return np.insert(likely, 4, np.float32(1), axis=1)


def _check_meaning(rows: NDArray[np.float32], export: Export) -> None:
    """Raise InferenceError for what no other step expects; numbers that are not finite are left to it."""
    scores = rows[:, 4 : 5 + len(export.class_names)]
    if (rows[:, 2:4] < 0).any() or (scores < 0).any() or (scores > 1).any():
        raise InferenceError(
            "The outputs of this export have another meaning: expected boxes of positive size and scores "
            "from 0 to 1, found others. Export the model again, with its usual head, or use the .pt."
        )
