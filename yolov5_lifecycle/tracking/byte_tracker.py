"""ByteTrack: identities for the detections of one camera, in its stages, and detection with identities.

Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every Detection Box" (ECCV 2022), with time in
seconds instead of frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.nms import Selection, narrowed
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.tracking.assignment import Indices, best_pairs, iou_matrix
from yolov5_lifecycle.tracking.camera_motion import CameraMotion
from yolov5_lifecycle.tracking.motion import (
    UNCONFIRMED,
    Similarity,
    Tracks,
)

MAX_DETECTIONS = 1000
"""Detections tracked per image, highest scores first; bounds the time per image."""
MAX_TRACKS = 2 * MAX_DETECTIONS
"""Tracks that are kept, the most recently seen; bounds time and memory."""
STEP_WITHOUT_TIME_S = 1 / 30
"""Assumed time between two images with equal stamps: some cameras set none."""
MAX_LATE_S = 1.0
"""An image that is older than the newest one by no more than this is late; by more, time has begun again."""


@dataclass
class StampCounts:
    """How often the stamps of a camera were not in order; one thread counts, any thread may read."""

    late: int = 0
    """Images that were not tracked, because a newer one had been."""
    jumps: int = 0
    """Jumps back in time, at each of which tracking began again."""
    last_jump_s: float = 0.0
    """How far the last one went back."""


class ByteTracker:
    """Tracks the objects of one camera.

    `ids` gives the number of each new track, above 0; trackers that share it never give the same one.
    `counts` are continued. Raises ValueError, with how to install it, when scipy is not installed.
    """

    def __init__(self, ids: Iterator[int], counts: StampCounts | None = None) -> None:
        if absence := absence_of("scipy.optimize"):
            raise ValueError(absence)
        self._ids = ids
        self._counts = counts or StampCounts()
        self._tracks = Tracks.none()
        self._stamp_s = -math.inf

    def __len__(self) -> int:
        """Tracks that are kept, unconfirmed and lost ones included."""
        return len(self._tracks)

    @property
    def confirmed(self) -> int:
        """Tracks with an id that are kept, lost ones included; may be asked in any thread."""
        return int(self._tracks.is_confirmed.sum())

    def reset(self) -> None:
        """Forget all tracks. Idempotent."""
        self._tracks = Tracks.none()
        self._stamp_s = -math.inf

    def is_late(self, stamp_s: float) -> bool:
        """Whether `update` will leave an image of this stamp out, as a newer one has been tracked."""
        return 0 < self._stamp_s - stamp_s <= MAX_LATE_S

    def update(
        self,
        detections: Detections,
        *,
        stamp_s: float,
        settings: Settings,
        camera: Similarity | None = None,
    ) -> tuple[str, ...]:
        """The id of each of the `detections` in the next image; "" for one without a confirmed track.

        `camera` maps pixels of the last image to those of this one, if it is known to have moved. Those of
        the `settings` that begin with track_ may change without losing tracks.

        `detections` reach down to `track_low_threshold`, below the threshold of what is published. `stamp_s`
        is in seconds since any epoch; one that is late changes nothing, and has no ids; one even earlier, or
        later than the newest by more than `track_timeout`, starts afresh. Raises ValueError when it is not
        finite.
        """
        if not math.isfinite(stamp_s):
            raise ValueError(f"stamp_s must be finite, found {stamp_s}.")
        if self.is_late(stamp_s):
            self._counts.late += 1
            return ("",) * len(detections)
        if stamp_s < self._stamp_s:
            self._counts.last_jump_s = self._stamp_s - stamp_s
            self._counts.jumps += 1
            self.reset()
        step_s = stamp_s - self._stamp_s or STEP_WITHOUT_TIME_S
        tracks = self._tracks.later(step_s, settings.track_timeout)
        if camera is not None:
            tracks = tracks.seen_from(camera)
        rows, columns = _associated(tracks, detections, settings)
        numbers = np.full(len(detections), UNCONFIRMED, np.int64)
        numbers[columns] = [number or next(self._ids) for number in tracks.numbers[rows].tolist()]
        seen = replace(
            tracks.at(rows).corrected(detections.boxes_xyxy[columns], detections.scores[columns], step_s),
            class_ids=detections.class_ids[columns],
            numbers=numbers[columns],
        )
        lost = tracks.at(_without(np.flatnonzero(tracks.is_confirmed), rows))
        self._tracks = _latest(seen.followed_by(_begun(detections, columns, settings)).followed_by(lost))
        self._stamp_s = stamp_s
        return tuple(str(number) if number else "" for number in numbers.tolist())


def _begun(detections: Detections, taken: Indices, settings: Settings) -> Tracks:
    """Tracks of the detections of a high score that are not `taken`."""
    high = np.flatnonzero(detections.scores[:MAX_DETECTIONS] >= settings.track_high_threshold)
    rows = _without(high, taken)
    return Tracks.started(detections.boxes_xyxy[rows], detections.scores[rows], detections.class_ids[rows])


def _latest(tracks: Tracks) -> Tracks:
    """At most MAX_TRACKS tracks, those seen last."""
    if len(tracks) <= MAX_TRACKS:
        return tracks
    return tracks.at(np.sort(np.argsort(tracks.unseen_s, kind="stable")[:MAX_TRACKS]))


def _associated(tracks: Tracks, detections: Detections, settings: Settings) -> tuple[Indices, Indices]:
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

    first = best_pairs(similarity, confirmed, high, threshold)
    second = best_pairs(similarity, _without(confirmed, first[0]), low, threshold)
    third = best_pairs(similarity, unconfirmed, _without(high, first[1]), threshold)
    rows, columns = zip(first, second, third, strict=True)
    return np.concatenate(rows), np.concatenate(columns)


def _without(indices: Indices, removed: Indices) -> Indices:
    """`indices` that are not in `removed`."""
    return indices[~np.isin(indices, removed)]


def _similarity(
    tracks: Tracks,
    detections: Detections,
    count: int,
    settings: Settings,
) -> NDArray[np.float64]:
    """IoU (n, count) of the tracks with the first `count` detections; 0 where the classes differ.

    Between two images of a slow camera an object may leave its predicted box, so boxes are compared with a
    margin, as in C-BIoU (Yang et al. 2023): the uncertainty of the prediction, which is small at 30 Hz.
    """
    similarity = iou_matrix(tracks.boxes_xyxy, detections.boxes_xyxy[:count], tracks.margin_xy)
    if not settings.track_across_classes:
        similarity[tracks.class_ids[:, None] != detections.class_ids[:count]] = 0
    return similarity


@dataclass(frozen=True)
class TrackedDetection:
    """The tracker of one camera with its current settings; `with_settings` of others keeps the tracks.

    The detector also reports lower scores, which may continue a track.
    """

    tracker: ByteTracker
    settings: Settings
    camera: CameraMotion = field(default_factory=CameraMotion)

    @classmethod
    def started(
        cls, settings: Settings, ids: Iterator[int], counts: StampCounts | None = None
    ) -> TrackedDetection | None:
        """Without tracks; None if `settings` ask for no tracker. For `ids` and `counts` see ByteTracker."""
        if settings.tracker == "none":
            return None
        return cls(ByteTracker(ids, counts), settings)

    def with_settings(self, settings: Settings) -> TrackedDetection:
        """The same tracker and tracks with `settings`."""
        return replace(self, settings=settings)

    def detect(
        self, detector: Detector, image: ColourImage, selection: Selection, stamp_s: float
    ) -> Detections:
        """What `detector` finds in `image` with `selection`, and `track_ids`; `stamp_s` in seconds.

        Raises InferenceError like `Detector.detect`.
        """
        return self.follow(detector.detect(image, self.wider(selection)), image, selection, stamp_s)

    def wider(self, selection: Selection) -> Selection:
        """`selection`, extended by what may continue a track."""
        return selection.wider(self.settings.track_low_threshold)

    def follow(
        self, found: Detections, image: ColourImage, selection: Selection, stamp_s: float
    ) -> Detections:
        """The detections that `selection` admits, with `track_ids`.

        `found`: those of the wider selection in `image`.
        """
        camera = None
        if self.settings.track_camera_motion == "off":
            self.camera.reset()
        elif not self.tracker.is_late(stamp_s):
            camera = self.camera.since_last(image, found.boxes_xyxy)
        ids = self.tracker.update(found, stamp_s=stamp_s, settings=self.settings, camera=camera)
        return narrowed(replace(found, track_ids=ids), selection)
