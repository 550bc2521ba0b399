"""The embedded model as the detector of scenes that are drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmark.tracking.camera_path import SIZE_HW
from benchmark.tracking.recording import MIN_SCORE, Detect, partly_missed
from benchmark.tracking.scenes import View
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.prepared_model import load_detector
from yolov5_lifecycle.images.image import ColourImage

_WEIGHTS = Path(__file__).parents[2] / "weights" / "shapes.safetensors"
_SELECTION = Selection(confidence_threshold=MIN_SCORE)


def shapes_detector() -> Detector:
    """The detector of the embedded model, for images of SIZE_HW."""
    detector = load_detector(load_weights(_WEIGHTS).model, device="cpu", runtime="torch", image_size=320)
    detector.warm_up([SIZE_HW])
    return detector


def rendered(detector: Detector, rng: np.random.Generator) -> Detect:
    """Detects in the images, and drops a fifth of what is found."""

    def detect(_: View, image: ColourImage | None) -> Detections:
        if image is None:
            raise ValueError("Expected a film, found none: without images there is nothing to detect in.")
        return partly_missed(detector.detect(image, _SELECTION), rng)

    return detect
