"""Raw predictions -> detections: box conversion, thresholds and non-maximum suppression (NMS)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.region import BoxFilter

MAX_CANDIDATES = 30_000
"""Maximum boxes that enter NMS, highest scores first, as in YOLOv5."""

WORTH_TELLING = 0.05
"""Minimum score of a missed detection worth reporting; scores below are noise."""


Counts = Callable[[NDArray[np.float32]], NDArray[np.bool_]]
"""Which of the boxes (n, 4), in network pixels, count; see `BoxFilter`."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """NMS and filter parameters; thresholds in [0, 1], `classes` None means all."""

    confidence_threshold: float = 0.25
    """Threshold of the classes without their own."""
    class_thresholds: tuple[tuple[int, float], ...] = ()
    """Class ids, each once, and their own thresholds."""
    extra_threshold: float | None = None
    """Scores above it are reported, too, after those above their thresholds; see `wider`."""
    iou_threshold: float = 0.45
    max_detections: int = 1000
    classes: frozenset[int] | None = None
    agnostic_nms: bool = False
    box_filter: BoxFilter | None = None
    """None: all boxes count."""
    with_masks: bool = False
    """Whether to compute masks; without effect if the model does not segment."""
    with_embedding: bool = False
    """Whether to compute `Detections.embedding`."""

    def wider(self, threshold: float) -> Selection:
        """Reports scores above `threshold`, too: a tracker or a collection of images needs them."""
        present = self.extra_threshold
        return replace(self, extra_threshold=threshold if present is None else min(present, threshold))

    @property
    def min_score(self) -> float:
        """The lowest threshold that applies to a selected class."""
        wanted = self.classes
        own = [value for class_id, value in self.class_thresholds if wanted is None or class_id in wanted]
        others = [] if wanted and len(own) == len(wanted) else [self.confidence_threshold]
        tracked = [] if self.extra_threshold is None else [self.extra_threshold]
        return min([*own, *others, *tracked])

    @property
    def min_objectness(self) -> float:
        """Minimum objectness of a prediction that can become a detection or `best_missed`."""
        return min(self.min_score, WORTH_TELLING)

    def above_thresholds(
        self, scores: NDArray[np.float32], class_ids: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Which of the detections (n,) score above the threshold of their class."""
        if not self.class_thresholds:
            return scores > self.confidence_threshold
        return scores > self.thresholds(class_ids)

    def reports(self, scores: NDArray[np.float32], class_ids: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which of the detections (n,) are above their threshold, or the extra one."""
        reported = self.above_thresholds(scores, class_ids)
        return reported if self.extra_threshold is None else reported | (scores > self.extra_threshold)

    def thresholds(self, class_ids: NDArray[np.int64]) -> NDArray[np.float32]:
        """The threshold (n,) of each class."""
        own = dict(self.class_thresholds)
        count = max([*own, int(class_ids.max(initial=0))]) + 1
        of_classes = np.full(count, self.confidence_threshold, np.float32)
        of_classes[list(own)] = list(own.values())
        return of_classes[class_ids]


@dataclass(frozen=True, eq=False)
class Selected(Detections):
    """Detections in network pixels."""

    rows: NDArray[np.int64] = field(kw_only=True)
    """(n,) indices into the raw predictions."""


def cxcywh_to_xyxy(boxes_cxcywh: NDArray[np.float32]) -> NDArray[np.float32]:
    """Centre and size (n, 4) -> corners (n, 4)."""
    centre, half_size = boxes_cxcywh[:, :2], boxes_cxcywh[:, 2:] / 2
    return np.concatenate((centre - half_size, centre + half_size), axis=1)


def select(raw: NDArray[np.float32], selection: Selection, counts: Counts | None = None) -> Selected:
    """Detections in network pixels, highest score first, from raw predictions (n, 5 + C).

    YOLOv5's rules with one class per box: objectness, and objectness * best class score, both above the
    threshold, then NMS per class, or across classes when agnostic. The score is the product. Boxes that do
    not count suppress others, but take no place among `max_detections`.
    Raises ValueError when a box or score above the threshold is infinite, or a box is NaN.
    """
    found = _in_order(_scored(raw, selection.min_score, selection.classes), selection)
    boxes_xyxy = cxcywh_to_xyxy(raw[found.rows, :4])
    if not np.isfinite(boxes_xyxy).all():
        raise ValueError("The boxes of raw predictions must be finite numbers, found NaN or infinity.")
    counted = None if counts is None else counts(boxes_xyxy)
    best_filtered = 0.0
    if counted is not None:
        dropped = found.at(~counted)
        is_above = selection.above_thresholds(dropped.scores, dropped.class_ids)
        best_filtered = float(dropped.scores[is_above].max(initial=0.0))
    kept = suppress(
        boxes_xyxy,
        groups=np.zeros_like(found.class_ids) if selection.agnostic_nms else found.class_ids,
        iou_threshold=selection.iou_threshold,
        limit=selection.max_detections,
        counted=counted,
    )
    kept = kept[np.argsort(-found.scores[kept], kind="stable")]
    return Selected(
        boxes_xyxy[kept],
        found.scores[kept],
        found.class_ids[kept],
        best_missed=0.0 if len(kept) else _best_missed(raw, selection, counts),
        best_filtered=best_filtered,
        rows=found.rows[kept],
    )


def narrowed(detections: Detections, selection: Selection) -> Detections:
    """Those of `detections` that `selection` reports: they were found with a wider one.

    In NMS no lower score removes a higher one, and none below its threshold removes one above its own, so
    these are the same as with `selection` alone. Without any, `best_missed` is the highest score worth
    reporting, as it would be there.
    """
    is_reported = selection.reports(detections.scores, detections.class_ids)
    best_missed = detections.best_missed
    if not is_reported.any() and len(detections) and detections.scores[0] > WORTH_TELLING:
        best_missed = float(detections.scores[0])
    return replace(detections[is_reported], best_missed=best_missed)


class _Candidates(NamedTuple):
    """Rows (n,) of raw predictions, with their scores and class ids."""

    rows: NDArray[np.int64]
    scores: NDArray[np.float32]
    class_ids: NDArray[np.int64]

    def at(self, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> _Candidates:
        return _Candidates(self.rows[chosen], self.scores[chosen], self.class_ids[chosen])


def _scored(raw: NDArray[np.float32], threshold: float, classes: frozenset[int] | None) -> _Candidates:
    """The rows in `classes` with a score above the threshold."""
    rows = np.flatnonzero(raw[:, 4] > threshold)
    likely = raw[rows]
    class_ids = likely[:, 5:].argmax(axis=1).astype(np.int64)
    scores = likely[:, 4] * likely[np.arange(len(likely)), 5 + class_ids]
    wanted = scores > threshold
    if classes is not None:
        wanted &= np.isin(class_ids, list(classes))
    return _Candidates(rows, scores, class_ids).at(wanted)


def _in_order(found: _Candidates, selection: Selection) -> _Candidates:
    """The MAX_CANDIDATES that go first in NMS, in this order, of those that `selection` needs.

    With thresholds of classes and a tracker at the same time, those that are published go first: a higher
    score below its threshold must not replace one above its own.
    """
    if not selection.class_thresholds:
        return found.at(np.argsort(-found.scores, kind="stable")[:MAX_CANDIDATES])
    found = found.at(selection.reports(found.scores, found.class_ids))
    is_above = selection.above_thresholds(found.scores, found.class_ids)
    return found.at(np.lexsort((-found.scores, ~is_above))[:MAX_CANDIDATES])


def _best_missed(raw: NDArray[np.float32], selection: Selection, counts: Counts | None) -> float:
    """The highest score worth reporting that is not above its threshold, of a box that counts.

    Of many, only the MAX_CANDIDATES highest are compared with the regions, which takes time.
    """
    found = _scored(raw, WORTH_TELLING, selection.classes)
    if counts is not None:
        below = found.at(~selection.above_thresholds(found.scores, found.class_ids))
        found = below.at(np.argsort(-below.scores, kind="stable")[:MAX_CANDIDATES])
        found = found.at(counts(cxcywh_to_xyxy(raw[found.rows, :4])))
    return float(found.scores.max(initial=0.0))


def suppress(
    boxes_xyxy: NDArray[np.float32],
    *,
    groups: NDArray[np.int64],
    iou_threshold: float,
    limit: int,
    counted: NDArray[np.bool_] | None = None,
) -> NDArray[np.int64]:
    """Greedy NMS: indices of at most `limit` kept boxes, best first.

    A box is dropped when its IoU with a kept, better box of its group is above the threshold. Boxes (n, 4)
    are in order, the best first. Only those that are `counted` are returned.
    """
    boxes_xywh = _apart(boxes_xyxy, groups)
    # The boxes kept from the best are a prefix of those kept from all, so the tail can be skipped once
    # `limit` are kept: of 25,200 boxes with little overlap the first 1,000 took 0.05 s, all 2.6 to 5 s.
    count = max(2 * limit, 1000)
    while True:
        best = boxes_xywh[:count]
        ranks = np.arange(len(best), 0, -1, dtype=np.float32)  # scores, of which only the order counts
        # A list, because OpenCV reads an array three times slower. OpenCV 4.6 has no NMSBoxesBatched.
        found = cv2.dnn.NMSBoxes(best.tolist(), ranks, 0.0, iou_threshold)
        kept = np.asarray(found, np.int64).reshape(-1)  # an empty tuple when no box is kept
        if counted is not None:
            kept = kept[counted[kept]]
        if len(kept) >= limit or count >= len(boxes_xywh):
            return kept[:limit]
        count *= 2


def _apart(boxes_xyxy: NDArray[np.float32], groups: NDArray[np.int64]) -> NDArray[np.float64]:
    """Corner and size (n, 4), each group offset so that boxes of different groups cannot overlap."""
    boxes = boxes_xyxy.astype(np.float64)
    if len(boxes):
        boxes[:, 0::2] += (groups * np.ptp(boxes[:, 0::2]))[:, None]
    boxes[:, 2:] -= boxes[:, :2]
    return boxes
