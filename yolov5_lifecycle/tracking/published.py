"""What is published of the detections that were tracked."""

from __future__ import annotations

from collections.abc import Sequence

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.nms import WORTH_TELLING


def published(detections: Detections, ids: Sequence[str], confidence_threshold: float) -> Detections:
    """The `detections` with a score above `confidence_threshold`, with their `ids`.

    NMS lets no lower score remove a higher one, so these are what NMS with this threshold would give.
    Without any, `best_missed` is the highest score that is worth telling, as it is there.
    """
    count = int((detections.scores > confidence_threshold).sum())
    best_missed = detections.best_missed
    if count == 0 and len(detections) and detections.scores[0] > WORTH_TELLING:
        best_missed = float(detections.scores[0])
    return Detections(
        boxes_xyxy=detections.boxes_xyxy[:count],
        scores=detections.scores[:count],
        class_ids=detections.class_ids[:count],
        best_missed=best_missed,
        track_ids=tuple(ids[:count]),
    )
