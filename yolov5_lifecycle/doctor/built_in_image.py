"""A synthetic image and this package's own network: what it must find there, whatever runs it."""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.detection.python_api import load_model
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene, Truth

WEIGHTS = "package://yolov5_lifecycle/weights/shapes.safetensors"
SEED = 8
SIZE_HW = (480, 640)
_IMAGE_SIZE = 640  # that of the calibration for int8
_RUNS = 5


@dataclass(frozen=True)
class Tolerance:
    """How much the same detection may differ: in pixels of a corner, and in the score."""

    corner_px: float
    score: float


EXACT = Tolerance(corner_px=1.0, score=0.01)
COARSE = Tolerance(corner_px=6.0, score=0.15)
"""For precisions below fp32, and for the ground truth."""


@dataclass(frozen=True, eq=False)
class Result:
    """The detections, and the median milliseconds of a detection."""

    detections: Detections
    median_ms: float


def image() -> tuple[NDArray[np.uint8], Truth]:
    """RGB pixels (480, 640, 3) of six shapes, and their ground truth."""
    return Scene(SEED, SIZE_HW).frame(0)


def detected(*, runtime: str, device: str = "cpu", precision: str = "fp32") -> Result:
    """What the network finds in `image`; raises what `load_model` and `Detector` raise."""
    pixels, _ = image()
    detector = load_model(
        WEIGHTS, runtime=runtime, device=device, precision=precision, image_size=_IMAGE_SIZE
    )
    try:
        times_ms = []
        for _ in range(_RUNS):
            begun_s = time.perf_counter()
            detector(pixels, order="rgb")
            times_ms.append(1e3 * (time.perf_counter() - begun_s))
        return Result(detector(pixels, order="rgb"), statistics.median(times_ms))
    finally:
        detector.runtime.close()


def truth() -> Detections:
    """The ground truth as detections."""
    _, true = image()
    return Detections(true.boxes_xyxy, np.ones(len(true.class_ids), np.float32), true.class_ids)


def difference(expected: Detections, found: Detections, tolerance: Tolerance) -> str:
    """The first object of one that the other lacks or has elsewhere; "" if there is none.

    Objects whose scores are so near to the threshold that they may be on either side of it are left out.
    """
    for one, other, word in ((expected, found, "lacks"), (found, expected, "also has")):
        for box, score, class_id in zip(one.boxes_xyxy, one.scores, one.class_ids, strict=True):
            corners = np.abs(other.boxes_xyxy - box).max(axis=1, initial=0.0)
            is_same = (other.class_ids == class_id) & (corners <= tolerance.corner_px)
            is_same &= np.abs(other.scores - score) <= tolerance.score
            if not is_same.any() and score > Selection().confidence_threshold + tolerance.score:
                return f"it {word} {CLASS_NAMES[class_id]} {score:.2f} at {box.round().astype(int).tolist()}"
    return ""
