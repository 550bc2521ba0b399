"""How far two detectors agree on the same images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.tracking.assignment import iou_matrix

_SMALLEST_IOU = 0.5


@dataclass(frozen=True)
class Agreement:
    """Detections of one detector, those of another one taken as the truth."""

    f1: float
    """Harmonic mean of precision and recall; 1 if neither found anything."""
    box_iou: float
    """Mean IoU of the pairs; 0 without any."""


def agreement(truth: Sequence[Detections], found: Sequence[Detections]) -> Agreement:
    """Compare image by image: pairs are of one class and an IoU of at least 0.5, the best found first."""
    ious: list[float] = []
    for true, other in zip(truth, found, strict=True):
        ious += _pair_ious(true, other)
    total = sum(map(len, truth)) + sum(map(len, found))
    return Agreement(2 * len(ious) / total if total else 1.0, float(np.mean(ious)) if ious else 0.0)


def _pair_ious(truth: Detections, found: Detections) -> list[float]:
    ious = []
    free = iou_matrix(found.boxes_xyxy, truth.boxes_xyxy)
    free[found.class_ids[:, None] != truth.class_ids] = 0
    for row in free:
        if len(row) and row.max() >= _SMALLEST_IOU:
            ious.append(float(row.max()))
            free[:, row.argmax()] = 0
    return ious
