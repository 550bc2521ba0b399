"""Runtime of an export to ONNX, whose graph an engine runs as it is."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.models.model import Export
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.runtimes.compiled_runtime import (
    Engine,
    Loaded,
    Run,
    Threads,
    check_processor,
    processor_threads,
    write_planes,
)
from yolov5_lifecycle.runtimes.networks_by_shape import closed, denormals_as_zero
from yolov5_lifecycle.runtimes.runtime import InferenceError, Predictions


class ExportedRuntime:
    """`export` on the CPU. See `Runtime`.

    Its embeddings are empty. Rows of an export without objectness have 1 there, and those whose best class
    scores below the least objectness that is asked for are left out.
    """

    device = "cpu"

    def __init__(self, export: Export, engine: Engine, threads: Threads, loaded: Loaded) -> None:
        self.name = engine.name
        self.precision = export.precision
        self._export, self._engine, self._threads = export, engine, threads
        self._run: Run | None = loaded.new_run()
        """None once closed."""

    @classmethod
    def load(cls, export: Export, engine: Engine, *, device: str) -> ExportedRuntime:
        """Raises DeviceError for a device that the engine does not support; InferenceError."""
        check_processor(device, engine, otherwise="the .pt and runtime 'torch'")
        return cls._with_threads(export, engine, processor_threads())

    @classmethod
    def _with_threads(cls, export: Export, engine: Engine, threads: Threads) -> ExportedRuntime:
        return cls(export, engine, threads, _restored(export, engine, threads))

    def __call__(self, frame: NDArray[np.uint8], order: Order, min_objectness: float = 0.0) -> Predictions:
        """See `Runtime`. An export with a fixed batch runs filled up with black."""
        planes = np.zeros((self._export.batch or 1, self._export.channels, *frame.shape[:2]), np.uint8)
        write_planes(frame, order, planes[0])
        outputs = self._outputs(planes)
        rows = _likely_rows(
            np.asarray(outputs[self._export.boxes], np.float32)[0], self._export, min_objectness
        )
        _check_meaning(rows, self._export)
        compute_prototypes = None
        if (prototypes := self._export.prototypes) is not None:  # copied: the next run may overwrite them
            compute_prototypes = partial(np.asarray, np.array(outputs[prototypes][0], np.float32))
        return Predictions(rows, compute_prototypes, _empty)

    def _outputs(self, planes: NDArray[np.uint8]) -> Sequence[NDArray[np.generic]]:
        if (run := self._run) is None:
            raise closed()
        pixels = np.multiply(planes, 1 / 255, dtype=np.float32)
        try:
            with denormals_as_zero():
                return run(pixels.astype(np.float16) if self._export.is_half else pixels)
        except self._engine.errors as error:
            problem = in_one_line(str(error))
        raise InferenceError(f"{self.name} failed on {self.device}: {problem}")

    def lanes(self, count: int, threads: int) -> list[ExportedRuntime]:
        """See `Runtime`."""
        self._open()
        shared = Threads(threads, at_once=count)
        loaded = _restored(self._export, self._engine, shared)
        return [ExportedRuntime(self._export, self._engine, shared, loaded) for _ in range(count)]

    def close(self) -> None:
        """See `Runtime`."""
        self._run = None

    def _open(self) -> None:
        if self._run is None:
            raise closed()


def _restored(export: Export, engine: Engine, threads: Threads) -> Loaded:
    try:
        with denormals_as_zero():  # the engine leaves this thread in that mode
            return engine.restore(export.graph, threads)
    except engine.errors as error:
        problem = in_one_line(str(error))
    raise InferenceError(f"{engine.name} cannot load this export: {problem}")


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
