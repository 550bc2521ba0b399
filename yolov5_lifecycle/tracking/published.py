"""What is published of the detections that were tracked."""

from __future__ import annotations

from collections.abc import Sequence

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import WORTH_TELLING


def published(
    detections: Detections, ids: Sequence[str], confidence_threshold: float
) -> tuple[Detections, tuple[str, ...]]:
    """The `detections` with a score above `confidence_threshold`, and their `ids`.

    NMS lets no lower score remove a higher one, so these are what NMS with this threshold would give.
    Without any, `best_missed` is the highest score that is worth telling, as it is there.
    """
    count = int((detections.scores > confidence_threshold).sum())
    best_missed = detections.best_missed
    if count == 0 and len(detections) and detections.scores[0] > WORTH_TELLING:
        best_missed = float(detections.scores[0])
    kept = Detections(
        detections.boxes_xyxy[:count], detections.scores[:count], detections.class_ids[:count], best_missed
    )
    return kept, tuple(ids[:count])
