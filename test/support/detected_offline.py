"""The command `detect_bag` with the embedded model, which is prepared once."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image
from vision_msgs.msg import Detection2DArray

from support.colcon_workspace import REPOSITORY
from support.scripted_runtime import ScriptedRuntime
from yolov5_lifecycle.detection.class_filter import selection_of
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.prepared_model import Prepare, PreparedModel, prepare_model
from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.sources.scene import CLASS_NAMES

MODEL = {
    "weights": str(REPOSITORY / "weights" / "shapes.safetensors"),
    "image_size": 320,
    "device": "cpu",
    "runtime": "torch",
}
SET_MODEL = [word for name, value in MODEL.items() for word in ("--set", f"{name}={value}")]

prepare_once = functools.cache(prepare_model)
run = functools.partial(main, prepare=prepare_once)


def prepare_raising(error: BaseException) -> Prepare:
    """Prepares a detector of the shapes whose inference raises `error`."""

    def infer() -> NDArray[np.float32]:
        raise error

    detector = Detector(ScriptedRuntime(infer), class_names=CLASS_NAMES, image_size=320, stride=32)
    return lambda settings, _: PreparedModel(settings, detector, Path("/raising.pt"), "0" * 64)


def published(message: Image | CompressedImage) -> tuple[Detection2DArray, Image]:
    """What the node publishes for `message`: detections and annotated image."""
    settings = Settings.model_validate(MODEL)
    detector = prepare_once(settings, (USUAL_SOURCE_HW,)).detector
    image = messages.image_of_message(message)
    detections = detector.detect(image, selection_of(settings, detector.class_names))
    drawn = annotate(image, detections, detector.class_names)
    return (
        messages.detection_array(detections, detector.class_names, message.header),
        messages.image_message(drawn, f"{image.channel_order}8", message.header),
    )
