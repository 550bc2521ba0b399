"""Which detection continues which track: the stages of ByteTrack."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.tracking.assignment import Indices, Solver, best_pairs, iou_matrix
from yolov5_lifecycle.tracking.tracker_settings import TrackerSettings
from yolov5_lifecycle.tracking.tracks import Tracks

MAX_DETECTIONS = 1000
"""Detections of an image that are tracked, highest scores first; it bounds the time of an image."""


def associated(
    tracks: Tracks, detections: Detections, settings: TrackerSettings, solver: Solver
) -> tuple[Indices, Indices]:
    """Rows of `tracks` and of the `detections` that continue them.

    First the confirmed tracks, lost ones included, are matched with the detections of a high score, then the
    rest of them with those of a low score; unconfirmed tracks are matched with the rest of the high ones.
    """
    scores = detections.scores[:MAX_DETECTIONS]
    high = np.flatnonzero(scores >= settings.track_high_threshold)
    low = np.flatnonzero((scores >= settings.track_low_threshold) & (scores < settings.track_high_threshold))
    confirmed, unconfirmed = np.flatnonzero(tracks.is_confirmed), np.flatnonzero(~tracks.is_confirmed)
    similarity = _similarity(tracks, detections, len(high) + len(low), settings)
    threshold = settings.track_match_threshold

    first = best_pairs(similarity, confirmed, high, threshold, solver)
    second = best_pairs(similarity, without(confirmed, first[0]), low, threshold, solver)
    third = best_pairs(similarity, unconfirmed, without(high, first[1]), threshold, solver)
    rows, columns = zip(first, second, third, strict=True)
    return np.concatenate(rows), np.concatenate(columns)


def without(indices: Indices, removed: Indices) -> Indices:
    """`indices` that are not in `removed`."""
    return indices[~np.isin(indices, removed)]


def _similarity(
    tracks: Tracks, detections: Detections, count: int, settings: TrackerSettings
) -> NDArray[np.float64]:
    """IoU (n, count) of the tracks with the first `count` detections; 0 where the classes differ.

    Between two images of a slow camera an object may leave its predicted box, so boxes are compared with a
    margin, as in C-BIoU (Yang et al. 2023): the uncertainty of the prediction, which is small at 30 Hz.
    """
    motion = tracks.motion
    similarity = iou_matrix(motion.boxes_xyxy, detections.boxes_xyxy[:count], motion.margin_xy)
    if not settings.track_across_classes:
        similarity[tracks.class_ids[:, None] != detections.class_ids[:count]] = 0
    return similarity
