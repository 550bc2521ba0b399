"""What the settings ask of a model that is loaded."""

from __future__ import annotations

from yolov5_lifecycle.boxes import Selection
from yolov5_lifecycle.class_filter import ClassFilterError, class_ids
from yolov5_lifecycle.settings import Problem, Settings


def model_problems(settings: Settings, class_names: tuple[str, ...]) -> list[Problem]:
    """What a model with `class_names` says against `settings`: the rules that need the loaded model."""
    try:
        class_ids(settings.classes, class_names)
    except ClassFilterError as error:
        return [Problem("classes", str(error))]
    return []


def selection(settings: Settings, class_names: tuple[str, ...]) -> Selection:
    """What to keep of the raw predictions; ClassFilterError unless `model_problems` has none."""
    return Selection(
        confidence_threshold=settings.confidence_threshold,
        iou_threshold=settings.iou_threshold,
        max_detections=settings.max_detections,
        classes=class_ids(settings.classes, class_names),
        agnostic_nms=settings.agnostic_nms,
    )
