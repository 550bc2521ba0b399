"""From raw predictions to detections: box algebra, thresholds, non-maximum suppression."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detections import Detections

MAX_CANDIDATES = 30_000
"""Of more boxes above the threshold only the best enter the suppression, as in YOLOv5."""

WORTH_TELLING = 0.05
"""A score below is noise: a threshold that lets it pass would be of no use."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Which predictions become detections; thresholds in [0, 1], `classes` None means all."""

    confidence_threshold: float = 0.25
    iou_threshold: float = 0.45
    max_detections: int = 1000
    classes: frozenset[int] | None = None
    agnostic_nms: bool = False

    @property
    def least_objectness(self) -> float:
        """A prediction of less can neither become a detection nor be the best one that was missed."""
        return min(self.confidence_threshold, WORTH_TELLING)


def cxcywh_to_xyxy(boxes_cxcywh: NDArray[np.float32]) -> NDArray[np.float32]:
    """Centre and size (n, 4) -> corners (n, 4)."""
    centre, half_size = boxes_cxcywh[:, :2], boxes_cxcywh[:, 2:] / 2
    return np.concatenate((centre - half_size, centre + half_size), axis=1)


def select(raw: NDArray[np.float32], selection: Selection) -> Detections:
    """Detections in network pixels, best first, from raw predictions (n, 5 + C) of a `Runtime`.

    YOLOv5's rules with one class a box: objectness, and objectness * best class score, both above the
    threshold, then suppression within each class, or across classes when agnostic. The score is the product.
    Raises ValueError when a box or score above the threshold is infinite, or a box NaN.
    """
    boxes_cxcywh, scores, class_ids = _scored(raw, selection.confidence_threshold, selection.classes)
    order = np.argsort(-scores, kind="stable")[:MAX_CANDIDATES]
    boxes_xyxy, scores, class_ids = cxcywh_to_xyxy(boxes_cxcywh[order]), scores[order], class_ids[order]
    if not np.isfinite(boxes_xyxy).all():
        raise ValueError("The boxes of raw predictions must be finite numbers, found NaN or infinity.")
    kept = suppress(
        boxes_xyxy,
        scores,
        groups=np.zeros_like(class_ids) if selection.agnostic_nms else class_ids,
        iou_threshold=selection.iou_threshold,
        limit=selection.max_detections,
    )
    best_missed = 0.0 if len(kept) else _scored(raw, WORTH_TELLING, selection.classes)[1].max(initial=0.0)
    return Detections(boxes_xyxy[kept], scores[kept], class_ids[kept], float(best_missed))


def _scored(
    raw: NDArray[np.float32], threshold: float, classes: frozenset[int] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.int64]]:
    """Boxes (n, 4), scores and class ids of the rows of `classes` that score above the threshold."""
    rows = raw[raw[:, 4] > threshold]
    class_ids = rows[:, 5:].argmax(axis=1).astype(np.int64)
    scores = rows[:, 4] * rows[np.arange(len(rows)), 5 + class_ids]
    wanted = scores > threshold
    if classes is not None:
        wanted &= np.isin(class_ids, list(classes))
    return rows[wanted, :4], scores[wanted], class_ids[wanted]


def suppress(
    boxes_xyxy: NDArray[np.float32],
    scores: NDArray[np.float32],
    *,
    groups: NDArray[np.int64],
    iou_threshold: float,
    limit: int,
) -> NDArray[np.int64]:
    """Greedy non-maximum suppression: indices, best first, of at most `limit` boxes that stay.

    A box goes when a better one of its group that stays overlaps it by an IoU above the threshold. Boxes
    (n, 4) come best first, with `scores` > 0.
    """
    boxes_xywh = _apart(boxes_xyxy, groups)
    # What stays of the best boxes begins what stays of all, so the tail need not be looked at once there are
    # enough: of 25,200 boxes that hardly overlap the first 1,000 took 0.05 s, all of them 2.6 to 5 s.
    count = max(2 * limit, 1000)
    kept = _nms(boxes_xywh[:count], scores[:count], iou_threshold)
    while len(kept) < limit and count < len(scores):
        count *= 2
        kept = _nms(boxes_xywh[:count], scores[:count], iou_threshold)
    return kept[:limit]


def _apart(boxes_xyxy: NDArray[np.float32], groups: NDArray[np.int64]) -> NDArray[np.float64]:
    """Corner and size (n, 4), each group moved so far that boxes of two groups cannot overlap."""
    boxes = boxes_xyxy.astype(np.float64)
    if len(boxes):
        boxes[:, 0::2] += (groups * np.ptp(boxes[:, 0::2]))[:, None]
    boxes[:, 2:] -= boxes[:, :2]
    return boxes


def _nms(
    boxes_xywh: NDArray[np.float64], scores: NDArray[np.float32], iou_threshold: float
) -> NDArray[np.int64]:
    # A list, as OpenCV takes three times as long to read an array. OpenCV 4.6 has no NMSBoxesBatched.
    kept = cv2.dnn.NMSBoxes(boxes_xywh.tolist(), scores, 0.0, iou_threshold)
    return np.asarray(kept, np.int64).reshape(-1)  # an empty tuple when nothing stays
