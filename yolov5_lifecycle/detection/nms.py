"""Raw predictions -> detections: box conversion, thresholds and non-maximum suppression (NMS)."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections

MAX_CANDIDATES = 30_000
"""Maximum boxes that enter NMS, highest scores first, as in YOLOv5."""

WORTH_TELLING = 0.05
"""Minimum score of a missed detection worth reporting; scores below are noise."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """NMS and filter parameters; thresholds in [0, 1], `classes` None means all."""

    confidence_threshold: float = 0.25
    iou_threshold: float = 0.45
    max_detections: int = 1000
    classes: frozenset[int] | None = None
    agnostic_nms: bool = False
    with_masks: bool = False
    """Whether to compute masks; without effect if the model does not segment."""

    @property
    def min_objectness(self) -> float:
        """Minimum objectness of a prediction that can become a detection or `best_missed`."""
        return min(self.confidence_threshold, WORTH_TELLING)


@dataclass(frozen=True, eq=False)
class Selected(Detections):
    """Detections in network pixels."""

    rows: NDArray[np.int64] = field(kw_only=True)
    """(n,) indices into the raw predictions."""


def cxcywh_to_xyxy(boxes_cxcywh: NDArray[np.float32]) -> NDArray[np.float32]:
    """Centre and size (n, 4) -> corners (n, 4)."""
    centre, half_size = boxes_cxcywh[:, :2], boxes_cxcywh[:, 2:] / 2
    return np.concatenate((centre - half_size, centre + half_size), axis=1)


def select(raw: NDArray[np.float32], selection: Selection) -> Selected:
    """Detections in network pixels, highest score first, from raw predictions (n, 5 + C).

    YOLOv5's rules with one class per box: objectness, and objectness * best class score, both above the
    threshold, then NMS per class, or across classes when agnostic. The score is the product.
    Raises ValueError when a box or score above the threshold is infinite, or a box is NaN.
    """
    rows, scores, class_ids = _scored(raw, selection.confidence_threshold, selection.classes)
    order = np.argsort(-scores, kind="stable")[:MAX_CANDIDATES]
    rows, scores, class_ids = rows[order], scores[order], class_ids[order]
    boxes_xyxy = cxcywh_to_xyxy(raw[rows, :4])
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
    return Selected(boxes_xyxy[kept], scores[kept], class_ids[kept], float(best_missed), rows=rows[kept])


def _scored(
    raw: NDArray[np.float32], threshold: float, classes: frozenset[int] | None
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int64]]:
    """Indices (n,) of the rows in `classes` with a score above the threshold, these scores and class ids."""
    rows = np.flatnonzero(raw[:, 4] > threshold)
    likely = raw[rows]
    class_ids = likely[:, 5:].argmax(axis=1).astype(np.int64)
    scores = likely[:, 4] * likely[np.arange(len(likely)), 5 + class_ids]
    wanted = scores > threshold
    if classes is not None:
        wanted &= np.isin(class_ids, list(classes))
    return rows[wanted], scores[wanted], class_ids[wanted]


def suppress(
    boxes_xyxy: NDArray[np.float32],
    scores: NDArray[np.float32],
    *,
    groups: NDArray[np.int64],
    iou_threshold: float,
    limit: int,
) -> NDArray[np.int64]:
    """Greedy NMS: indices of at most `limit` kept boxes, highest score first.

    A box is dropped when its IoU with a kept, higher-scoring box of its group is above the threshold. Boxes
    (n, 4) are sorted by descending score, with `scores` > 0.
    """
    boxes_xywh = _apart(boxes_xyxy, groups)
    # The boxes kept from the top scores are a prefix of those kept from all, so the tail can be skipped once
    # `limit` are kept: of 25,200 boxes with little overlap the first 1,000 took 0.05 s, all 2.6 to 5 s.
    count = max(2 * limit, 1000)
    kept = _nms(boxes_xywh[:count], scores[:count], iou_threshold)
    while len(kept) < limit and count < len(scores):
        count *= 2
        kept = _nms(boxes_xywh[:count], scores[:count], iou_threshold)
    return kept[:limit]


def _apart(boxes_xyxy: NDArray[np.float32], groups: NDArray[np.int64]) -> NDArray[np.float64]:
    """Corner and size (n, 4), each group offset so that boxes of different groups cannot overlap."""
    boxes = boxes_xyxy.astype(np.float64)
    if len(boxes):
        boxes[:, 0::2] += (groups * np.ptp(boxes[:, 0::2]))[:, None]
    boxes[:, 2:] -= boxes[:, :2]
    return boxes


def _nms(
    boxes_xywh: NDArray[np.float64], scores: NDArray[np.float32], iou_threshold: float
) -> NDArray[np.int64]:
    # A list, because OpenCV reads an array three times slower. OpenCV 4.6 has no NMSBoxesBatched.
    kept = cv2.dnn.NMSBoxes(boxes_xywh.tolist(), scores, 0.0, iou_threshold)
    return np.asarray(kept, np.int64).reshape(-1)  # an empty tuple when no box is kept
