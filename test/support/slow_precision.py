"""Average precision computed slowly, straight from its definition."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.matching import EvaluatedImage

IOUS = tuple(0.5 + 0.05 * step for step in range(10))


def average_precision(images: Sequence[EvaluatedImage], class_id: int, min_iou: float) -> float:
    """Average precision of a class; NaN without objects. Images without crowds alone."""
    ranked = sorted(
        (
            (-float(image.found.scores[row]), number, int(row))
            for number, image in enumerate(images)
            for row in np.flatnonzero(image.found.class_ids == class_id)
        )
    )
    free = {
        (number, int(row))
        for number, image in enumerate(images)
        for row in np.flatnonzero(image.truth.class_ids == class_id)
    }
    objects = len(free)
    if not objects:
        return float("nan")
    right = 0
    points = []
    for rank, (_, number, row) in enumerate(ranked, start=1):
        image = images[number]
        candidates = [
            (iou(image.found.boxes_xyxy[row].astype(np.float64), image.truth.xyxy[target]), target)
            for at, target in free
            if at == number
        ]
        best = max(candidates, default=(0.0, -1))
        if best[0] >= min_iou:
            free.discard((number, best[1]))
            right += 1
        points.append((right / objects, right / rank))
    recalls = [step / 100 for step in range(101)]
    precisions = [
        max((precision for recall, precision in points if recall >= least - 1e-12), default=0.0)
        for least in recalls
    ]
    return sum(precisions) / len(precisions)


def iou(box: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    width = min(box[2], other[2]) - max(box[0], other[0])
    height = min(box[3], other[3]) - max(box[1], other[1])
    shared = max(width, 0) * max(height, 0)
    return float(shared / (_area(box) + _area(other) - shared))


def _area(box: NDArray[np.float64]) -> float:
    return float((box[2] - box[0]) * (box[3] - box[1]))
