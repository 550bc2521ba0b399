"""Scenes drawn as images, in which the embedded model detects."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmark.track_recording import MIN_SCORE, Detect, partly_missed
from benchmark.track_scenes import SIZE_HW, TrackScene, View
from yolov5_lifecycle.checkpoints.locate import load_weights
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.loaded_detector import load_detector
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.images.image import ColourImage

_WEIGHTS = Path(__file__).parents[1] / "weights" / "shapes.safetensors"
_SELECTION = Selection(confidence_threshold=MIN_SCORE)


def shapes_detector() -> Detector:
    """The detector of the embedded model, for images of SIZE_HW."""
    detector = load_detector(load_weights(_WEIGHTS).model, device="cpu", runtime="torch", image_size=320)
    detector.warm_up([SIZE_HW])
    return detector


def rendered(detector: Detector, rng: np.random.Generator) -> Detect:
    """Draws the visible objects on noisy grey, detects in the image, and drops a fifth."""
    background = np.clip(rng.normal(114, 8, (*SIZE_HW, 3)), 0, 255).astype(np.uint8)

    def detect(scene: TrackScene, view: View) -> Detections:
        return partly_missed(
            detector.detect(ColourImage(scene.image(view, background), "rgb"), _SELECTION), rng
        )

    return detect
