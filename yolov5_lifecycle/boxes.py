"""From raw predictions to detections: box algebra, thresholds, non-maximum suppression."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detections import Detections

MAX_CANDIDATES = 30_000
"""Of more boxes above the threshold only the best enter the suppression, as in YOLOv5."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Which predictions become detections; thresholds in [0, 1]. `classes` None means all."""

    confidence_threshold: float = 0.25
    iou_threshold: float = 0.45
    max_detections: int = 1000
    classes: frozenset[int] | None = None
    agnostic_nms: bool = False


def cxcywh_to_xyxy(boxes_cxcywh: NDArray[np.float32]) -> NDArray[np.float32]:
    """Centre and size (n, 4) -> corners (n, 4)."""
    centre, half_size = boxes_cxcywh[:, :2], boxes_cxcywh[:, 2:] / 2
    return np.concatenate((centre - half_size, centre + half_size), axis=1)


def select(raw: NDArray[np.float32], selection: Selection) -> Detections:
    """Detections in network pixels, best first, from raw predictions (N, 5 + C) of `Network`.

    YOLOv5's rules with one class a box: objectness and objectness * best class score both above the threshold, then
    non-maximum suppression within each class, or across classes when agnostic. `raw` is not written to.
    """
    rows = raw[raw[:, 4] > selection.confidence_threshold]
    class_ids = rows[:, 5:].argmax(axis=1)
    scores = rows[:, 4] * rows[np.arange(len(rows)), 5 + class_ids]
    wanted = scores > selection.confidence_threshold
    if selection.classes is not None:
        wanted &= np.isin(class_ids, list(selection.classes))
    candidates = np.flatnonzero(wanted)
    best_first = candidates[np.argsort(-scores[candidates], kind="stable")][:MAX_CANDIDATES]
    boxes_xyxy = cxcywh_to_xyxy(rows[best_first, :4])
    scores, class_ids = scores[best_first], class_ids[best_first]
    kept = non_maximum_suppression(
        boxes_xyxy, scores, None if selection.agnostic_nms else class_ids, selection.iou_threshold
    )[: selection.max_detections]
    return Detections(boxes_xyxy[kept], scores[kept], class_ids[kept].astype(np.int64))


def non_maximum_suppression(
    boxes_xyxy: NDArray[np.float32],
    scores: NDArray[np.float32],
    class_ids: NDArray[np.int64] | None,
    iou_threshold: float,
) -> NDArray[np.int64]:
    """Indices of the boxes that no better box (of the same class, if given) overlaps by more than the threshold."""
    if not len(boxes_xyxy):
        return np.empty(0, np.int64)
    boxes_xywh = np.concatenate((boxes_xyxy[:, :2], boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]), axis=1).tolist()
    if class_ids is None:
        kept = cv2.dnn.NMSBoxes(boxes_xywh, scores, 0.0, iou_threshold)
    else:
        kept = cv2.dnn.NMSBoxesBatched(boxes_xywh, scores, class_ids, 0.0, iou_threshold)
    return np.asarray(kept, np.int64).reshape(-1)
