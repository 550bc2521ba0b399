"""Comparison of received detections with the ground truth."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Header
from vision_msgs.msg import BoundingBox2D, Detection2DArray

MATCHING_IOU = 0.5


@dataclass(frozen=True, eq=False)
class Sighting:
    """One received message: stamp of its image, latency since then, and its objects as columns."""

    stamp_ns: int
    latency_ms: float
    class_names: tuple[str, ...]
    scores: tuple[float, ...]
    boxes_xyxy: NDArray[np.float64]  # (n, 4), pixels of the source
    ids: tuple[str, ...] = ()  # of tracks or true objects, "" without one

    @classmethod
    def now(cls, message: Detection2DArray) -> Sighting:
        """Create a sighting of `message`, received now on the camera's machine."""
        image_ns = stamp_ns(message.header)
        best = [detection.results[0].hypothesis for detection in message.detections]
        return cls(
            stamp_ns=image_ns,
            latency_ms=(time.time_ns() - image_ns) / 1e6,
            class_names=tuple(hypothesis.class_id for hypothesis in best),
            scores=tuple(hypothesis.score for hypothesis in best),
            boxes_xyxy=np.array([_xyxy(detection.bbox) for detection in message.detections]).reshape(-1, 4),
            ids=tuple(detection.id for detection in message.detections),
        )

    @property
    def arrival_ns(self) -> int:
        """Arrival time on the clock of the stamp."""
        return self.stamp_ns + round(self.latency_ms * 1e6)

    def found_of(self, truth: Sighting) -> int:
        """Number of objects in `truth` matched here by a box of the same class with IoU >= MATCHING_IOU."""
        ious = pairwise_iou(truth.boxes_xyxy, self.boxes_xyxy)
        same = np.array(truth.class_names)[:, None] == np.array(self.class_names)[None, :]
        return int(((ious >= MATCHING_IOU) & same).any(axis=1).sum())


def matched(truth: Sighting, seen: Sighting) -> list[tuple[int, int]]:
    """Rows of matching true and seen objects: one to one, same class, IoU >= MATCHING_IOU."""
    ious = pairwise_iou(truth.boxes_xyxy, seen.boxes_xyxy)
    ious[np.array(truth.class_names)[:, None] != np.array(seen.class_names)[None, :]] = 0
    pairs: list[tuple[int, int]] = []
    while ious.size and ious.max() >= MATCHING_IOU:
        row, column = map(int, np.unravel_index(ious.argmax(), ious.shape))
        pairs.append((row, column))
        ious[row, :] = ious[:, column] = 0
    return pairs


def stamp_ns(header: Header) -> int:
    """Stamp in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def pairwise_iou(a_xyxy: NDArray[np.float64], b_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
    """IoU matrix (n, m) of boxes (n, 4) and (m, 4); 0 for two empty boxes."""
    corner = np.maximum(a_xyxy[:, None, :2], b_xyxy[None, :, :2])
    size = np.clip(np.minimum(a_xyxy[:, None, 2:], b_xyxy[None, :, 2:]) - corner, 0, None)
    shared = size.prod(axis=2)
    union = _areas(a_xyxy)[:, None] + _areas(b_xyxy)[None, :] - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0))


def recall(sightings: Iterable[Sighting], truths: dict[int, Sighting]) -> float:
    """Recall over the sightings that have ground truth; NaN if there are no ground-truth objects."""
    pairs = [(seen, truths[seen.stamp_ns]) for seen in sightings if seen.stamp_ns in truths]
    total = sum(len(truth.class_names) for _, truth in pairs)
    return sum(seen.found_of(truth) for seen, truth in pairs) / total if total else float("nan")


def objects_per_class(sightings: Sequence[Sighting]) -> Counter[str]:
    """Number of detected objects per class."""
    return Counter(name for seen in sightings for name in seen.class_names)


def _xyxy(bbox: BoundingBox2D) -> list[float]:
    x, y = bbox.center.position.x, bbox.center.position.y
    half_w, half_h = bbox.size_x / 2, bbox.size_y / 2
    return [x - half_w, y - half_h, x + half_w, y + half_h]


def _areas(boxes_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]).prod(axis=1))
