"""The measured calls of this project, by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmark.task import Task
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.nms import Selection, select
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import Picture
from yolov5_lifecycle.sources.scene import Scene

RUNTIME_PREFIX = "runtime "
_SCENE_SEED = 8
_CROWD = 300


def call_of(task: Task) -> Callable[[], object]:
    """A call that runs the task once: a runtime's forward (`RUNTIME_PREFIX`), or a detector stage."""
    runtime = task.name.removeprefix(RUNTIME_PREFIX)
    is_forward = runtime != task.name
    model = load_weights(Path(task.weights)).model
    detector = load_detector(model, runtime=runtime if is_forward else "auto", device="cpu")
    picture = scene_picture(task.picture_hw)
    if is_forward:
        letterbox = _letterbox(detector, picture)
        frame = letterbox.apply(picture.pixels)
        return lambda: detector.runtime(frame, picture.order, Selection().least_objectness)
    return _stage(task.name, detector, picture)


def scene_picture(picture_hw: tuple[int, int]) -> Picture:
    """A fixed image of shapes over clutter."""
    return Picture(np.ascontiguousarray(Scene(_SCENE_SEED, picture_hw).frame(0)[0][..., ::-1]), "bgr")


def _stage(name: str, detector: Detector, picture: Picture) -> Callable[[], object]:
    letterbox = _letterbox(detector, picture)
    frame = letterbox.apply(picture.pixels)
    raw = detector.runtime(frame, picture.order, Selection().least_objectness)
    crowded = _crowded(detector.runtime(frame, picture.order))
    stages: dict[str, Callable[[], object]] = {
        "letterbox": lambda: letterbox.apply(picture.pixels),
        "selection": lambda: letterbox.undo(select(raw, Selection()).boxes_xyxy),
        "crowded selection": lambda: letterbox.undo(select(crowded, Selection()).boxes_xyxy),
        "detector": lambda: detector.detect(picture, Selection()),
    }
    return stages[name]


def _crowded(raw: NDArray[np.float32]) -> NDArray[np.float32]:
    """Predictions with _CROWD objects, evenly spread over `raw`, the complete output."""
    crowded: NDArray[np.float32] = raw[np.linspace(0, len(raw) - 1, _CROWD).astype(int)]
    crowded[:, 4:6] = 0.9
    return crowded


def _letterbox(detector: Detector, picture: Picture) -> Letterbox:
    return Letterbox.fit(picture.size_hw, image_size=detector.image_size, stride=detector.stride)
