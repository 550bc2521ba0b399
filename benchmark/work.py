"""The measured calls of this project, by name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmark.contender import Task
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.letterbox import Letterbox
from yolov5_lifecycle.detection.nms import Selection, select
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ColourImage
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
    image = scene_image(task.image_hw)
    if is_forward:
        letterbox = _letterbox(detector, image)
        frame = letterbox.apply(image.pixels)
        return lambda: detector.runtime(frame, image.channel_order, Selection().min_objectness)
    return _stage(task.name, detector, image)


def scene_image(image_hw: tuple[int, int]) -> ColourImage:
    """A fixed image of shapes over clutter."""
    return ColourImage(np.ascontiguousarray(Scene(_SCENE_SEED, image_hw).frame(0)[0][..., ::-1]), "bgr")


def image_file(image_hw: tuple[int, int], folder: Path) -> Path:
    """The scene as an image file that a camera reads quickly."""
    path = folder / f"{image_hw[1]}x{image_hw[0]}.bmp"
    if not cv2.imwrite(str(path), scene_image(image_hw).pixels):
        raise OSError(f"{path} cannot be written")
    return path


def _stage(name: str, detector: Detector, image: ColourImage) -> Callable[[], object]:
    letterbox = _letterbox(detector, image)
    frame = letterbox.apply(image.pixels)
    raw = detector.runtime(frame, image.channel_order, Selection().min_objectness).rows
    crowded = _crowded(detector.runtime(frame, image.channel_order).rows)
    stages: dict[str, Callable[[], object]] = {
        "letterbox": lambda: letterbox.apply(image.pixels),
        "selection": lambda: letterbox.undo(select(raw, Selection()).boxes_xyxy),
        "crowded selection": lambda: letterbox.undo(select(crowded, Selection()).boxes_xyxy),
        "detector": lambda: detector.detect(image, Selection()),
    }
    return stages[name]


def _crowded(raw: NDArray[np.float32]) -> NDArray[np.float32]:
    """Predictions with _CROWD objects, evenly spread over `raw`, the complete output."""
    crowded: NDArray[np.float32] = raw[np.linspace(0, len(raw) - 1, _CROWD).astype(int)]
    crowded[:, 4:6] = 0.9
    return crowded


def _letterbox(detector: Detector, image: ColourImage) -> Letterbox:
    return Letterbox.fit(image.size_hw, image_size=detector.image_size, stride=detector.stride)
