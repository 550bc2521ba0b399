"""ByteTrack: identities for the detections of one camera.

Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every Detection Box" (ECCV 2022), with time in
seconds instead of frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.tracking.assignment import Indices, load_solver
from yolov5_lifecycle.tracking.association import MAX_DETECTIONS, associated, without
from yolov5_lifecycle.tracking.tracker_settings import TrackerSettings
from yolov5_lifecycle.tracking.tracks import UNCONFIRMED, Tracks

MAX_TRACKS = 2 * MAX_DETECTIONS
"""Tracks that are kept, those seen last; it bounds time and memory."""
STEP_WITHOUT_TIME_S = 1 / 30
"""Time between two images of equal stamps: some cameras give none."""


class ByteTracker:
    """Tracks the objects of one camera.

    `ids` gives the number of each new track, above 0; trackers that share it never give the same one.
    Raises TrackerAbsentError, a ValueError, when scipy is not installed.
    """

    def __init__(self, ids: Iterator[int]) -> None:
        self._solver = load_solver()
        self._ids = ids
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

    def update(self, detections: Detections, *, stamp_s: float, settings: TrackerSettings) -> tuple[str, ...]:
        """The id of each of the `detections` in the next image; "" for one without a confirmed track.

        `detections` reach down to `track_low_threshold`, below the threshold of what is published. `stamp_s`
        is in seconds since any epoch; one before that of the previous image, or later by more than
        `track_timeout`, starts afresh. Raises ValueError when it is not finite.
        """
        if not math.isfinite(stamp_s):
            raise ValueError(f"stamp_s must be finite, found {stamp_s}.")
        if stamp_s < self._stamp_s:
            self.reset()
        step_s = stamp_s - self._stamp_s or STEP_WITHOUT_TIME_S
        tracks = self._tracks.later(step_s, settings.track_timeout)
        rows, columns = associated(tracks, detections, settings, self._solver)
        numbers = np.full(len(detections), UNCONFIRMED, np.int64)
        numbers[columns] = [number or next(self._ids) for number in tracks.numbers[rows].tolist()]
        seen = tracks.at(rows).seen(detections, columns, numbers[columns], step_s)
        lost = tracks.at(without(np.flatnonzero(tracks.is_confirmed), rows))
        self._tracks = _latest(seen.followed_by(self._begun(detections, columns, settings)).followed_by(lost))
        self._stamp_s = stamp_s
        return tuple(str(number) if number else "" for number in numbers.tolist())

    def _begun(self, detections: Detections, taken: Indices, settings: TrackerSettings) -> Tracks:
        """Tracks of the detections of a high score that are not `taken`."""
        high = np.flatnonzero(detections.scores[:MAX_DETECTIONS] >= settings.track_high_threshold)
        return Tracks.started(detections, without(high, taken))


def _latest(tracks: Tracks) -> Tracks:
    """At most MAX_TRACKS tracks, those seen last."""
    if len(tracks) <= MAX_TRACKS:
        return tracks
    return tracks.at(np.sort(np.argsort(tracks.unseen_s, kind="stable")[:MAX_TRACKS]))
