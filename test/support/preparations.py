"""Stands in for the preparation of a model: hands out detectors with scripted runtimes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from support.scripted_runtime import ScriptedRuntime
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.detection.stream_choice import InferenceStreams
from yolov5_lifecycle.ros.observer import PATIENCE_S
from yolov5_lifecycle.settings.settings import Settings

CLASS_NAMES = ("cat", "dog")


def prediction(class_name: str, score: float) -> NDArray[np.float32]:
    """One raw row: a box of 20 x 10 network pixels around (32, 32)."""
    row = np.zeros((1, 5 + len(CLASS_NAMES)), np.float32)
    row[0, :5] = (32, 32, 20, 10, 1.0)
    row[0, 5 + CLASS_NAMES.index(class_name)] = score
    return row


class Preparations:
    """Stands in for `prepare_model`: hands out scripted detectors; `refusal` and `gate` control it.

    `run`, `compute_prototypes`, `mask_coefficients` and the number of `streams` are the next detector's.
    """

    def __init__(self) -> None:
        self.refusal = ""
        self.refusal_type: type[Exception] = ValueError
        self.on_refusal: Callable[[], None] = lambda: None
        self.gate = threading.Event()
        self.gate.set()
        self.begun = threading.Semaphore(0)
        self.sizes_hw: list[list[tuple[int, int]]] = []
        self.class_names = CLASS_NAMES
        self.streams = 0
        self.run: Callable[[], NDArray[np.float32]] = lambda: prediction("cat", 0.9)
        self.compute_prototypes: Callable[[], NDArray[np.float32]] | None = None
        self.mask_coefficients = 0
        self.runtimes: list[ScriptedRuntime] = []

    def __call__(self, settings: Settings, sizes_hw: Sequence[tuple[int, int]]) -> PreparedModel:
        self.sizes_hw.append(list(sizes_hw))
        self.begun.release()
        assert self.gate.wait(PATIENCE_S)
        if refusal := self.refusal:
            self.on_refusal()
            raise self.refusal_type(refusal)
        runtime = ScriptedRuntime(self.run)
        runtime.compute_prototypes = self.compute_prototypes
        self.runtimes.append(runtime)
        detector = Detector(
            runtime,
            class_names=self.class_names,
            image_size=settings.image_size,
            stride=32,
            mask_coefficients=self.mask_coefficients,
        )
        streams = InferenceStreams(detector.streams(self.streams, 1))
        return PreparedModel(settings, detector, Path("/scripted.pt"), "0" * 64, streams)

    @property
    def running(self) -> ScriptedRuntime:
        return self.runtimes[-1]
