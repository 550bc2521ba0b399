"""Settings that depend on the loaded model."""

from __future__ import annotations

from yolov5_lifecycle.detection.class_filter import ClassFilterError, class_ids
from yolov5_lifecycle.detection.nms import Selection
from yolov5_lifecycle.settings.settings import Problem, Settings

MODEL_DEPENDENT = frozenset({"classes"})
"""The settings whose validity depends on the loaded model."""


def model_problems(settings: Settings, class_names: tuple[str, ...]) -> list[Problem]:
    """Problems of `settings` with a loaded model that has `class_names`."""
    try:
        class_ids(settings.classes, class_names)
    except ClassFilterError as error:
        return [Problem("classes", str(error))]
    return []


def selection(settings: Settings, class_names: tuple[str, ...]) -> Selection:
    """NMS and filter parameters from `settings`; ClassFilterError when `model_problems` reports any."""
    return Selection(
        confidence_threshold=settings.confidence_threshold,
        iou_threshold=settings.iou_threshold,
        max_detections=settings.max_detections,
        classes=class_ids(settings.classes, class_names),
        agnostic_nms=settings.agnostic_nms,
    )
