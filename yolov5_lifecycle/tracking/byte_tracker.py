"""ByteTrack: identities for the detections of one camera, its settings and its stages.

Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every Detection Box" (ECCV 2022), with time in
seconds instead of frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.tracking.assignment import Indices, Solver, best_pairs, iou_matrix, load_solver
from yolov5_lifecycle.tracking.common_motion import CommonMotion
from yolov5_lifecycle.tracking.motion import Array, Motion, Similarity, xyxy_to_cxcywh

UNCONFIRMED = 0
"""The number of a track that was seen once."""
MAX_DETECTIONS = 1000
"""Detections tracked per image, highest scores first; bounds the time per image."""
MAX_TRACKS = 2 * MAX_DETECTIONS
"""Tracks that are kept, the most recently seen; bounds time and memory."""
STEP_WITHOUT_TIME_S = 1 / 30
"""Assumed time between two images with equal stamps: some cameras set none."""
MAX_LATE_S = 1.0
"""An image that is older than the newest one by no more than this is late; by more, time has begun anew."""
MAX_TIMEOUT_S = 60.0
_LEADING = 100
"""Detections and tracks that say what all have in common; bounds the time that this takes."""
_RECENT_S = 0.5
"""Before the last image, in which these tracks were seen."""


@dataclass(frozen=True, kw_only=True)
class TrackerSettings:
    """The settings of the user; each may change between two frames without losing tracks.

    Raises ValueError on construction when a value is out of range.
    """

    track_high_threshold: float = 0.25
    """Minimum score, in [0, 1], of a detection that may begin a track and that is associated first."""
    track_low_threshold: float = 0.1
    """Minimum score, in [0, track_high_threshold], of a detection that may continue a track."""
    track_match_threshold: float = 0.2
    """Minimum IoU, in (0, 1], of a detection and the predicted box of its track, each with its margin."""
    track_timeout: float = 1.5
    """Seconds, in (0, MAX_TIMEOUT_S], for which a track is kept without a detection."""
    track_across_classes: bool = False
    """Whether a track may continue with a detection of another class."""
    track_camera_motion: Literal["auto", "off"] = "auto"
    """Whether the motion of the camera is looked for in the images."""

    def __post_init__(self) -> None:
        high, low = self.track_high_threshold, self.track_low_threshold
        if not 0 <= high <= 1:
            raise ValueError(f"track_high_threshold must be in [0, 1], found {high}.")
        if not 0 <= low <= high:
            raise ValueError(
                f"track_low_threshold must be from 0 to track_high_threshold ({high}), found {low}."
            )
        if not 0 < self.track_match_threshold <= 1:
            raise ValueError(f"track_match_threshold must be in (0, 1], found {self.track_match_threshold}.")
        if not 0 < self.track_timeout <= MAX_TIMEOUT_S:
            raise ValueError(
                f"track_timeout must be above 0 and at most {MAX_TIMEOUT_S:g} seconds, "
                f"found {self.track_timeout}."
            )
        if self.track_camera_motion not in ("auto", "off"):
            raise ValueError(
                f"track_camera_motion must be 'auto' or 'off', found {self.track_camera_motion!r}."
            )


@dataclass
class StampCounts:
    """How often the stamps of a camera were not in order; one thread counts, any thread may read."""

    late: int = 0
    """Images that were not tracked, because a newer one had been."""
    jumps: int = 0
    """Jumps back in time, at each of which tracking began anew."""
    last_jump_s: float = 0.0
    """How far the last one went back."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """n tracks as parallel arrays."""

    motion: Motion
    class_ids: NDArray[np.int64]
    """(n,) class of the detection that each was last seen in."""
    numbers: NDArray[np.int64]
    """(n,) UNCONFIRMED, or unique and above 0."""
    unseen_s: NDArray[np.float64]
    """(n,) seconds since each was seen."""

    @classmethod
    def started(cls, detections: Detections, rows: Indices) -> Tracks:
        """Unconfirmed tracks for `rows` of `detections`."""
        motion = Motion.started(detections.boxes_xyxy[rows], detections.scores[rows])
        numbers = np.full(len(rows), UNCONFIRMED, np.int64)
        return cls(motion, detections.class_ids[rows], numbers, np.zeros(len(rows)))

    @classmethod
    def none(cls) -> Tracks:
        """No tracks."""
        integers = np.zeros(0, np.int64)
        return cls(Motion.started(np.zeros((0, 4)), np.zeros(0)), integers, integers, np.zeros(0))

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def is_confirmed(self) -> NDArray[np.bool_]:
        """(n,) whether each has a number."""
        return np.not_equal(self.numbers, UNCONFIRMED)

    def later(self, step_s: float, timeout_s: float) -> Tracks:
        """The tracks `step_s` seconds later, without those unseen for more than `timeout_s`."""
        if step_s > timeout_s:
            return Tracks.none()
        kept = self.at(np.flatnonzero(self.unseen_s + step_s <= timeout_s))
        return Tracks(kept.motion.predicted(step_s), kept.class_ids, kept.numbers, kept.unseen_s + step_s)

    def seen_from(self, camera: Similarity, velocity_xy: Array | float = 0.0) -> Tracks:
        """The tracks in the pixels of the next image, see `Motion.seen_from`."""
        return replace(self, motion=self.motion.seen_from(camera, velocity_xy))

    def seen(
        self, detections: Detections, rows: Indices, numbers: NDArray[np.int64], step_s: float
    ) -> Tracks:
        """The tracks after each was seen in its row of `detections`, `step_s` after the previous image.

        `numbers` (n,) are those that they have from now on.
        """
        motion = self.motion.corrected(detections.boxes_xyxy[rows], detections.scores[rows], step_s)
        return Tracks(motion, detections.class_ids[rows], numbers, np.zeros(len(self)))

    def at(self, rows: Indices) -> Tracks:
        """The tracks in `rows`."""
        return Tracks(self.motion.at(rows), self.class_ids[rows], self.numbers[rows], self.unseen_s[rows])

    def followed_by(self, other: Tracks) -> Tracks:
        """These tracks, then those of `other`."""
        return Tracks(
            self.motion.followed_by(other.motion),
            np.concatenate((self.class_ids, other.class_ids)),
            np.concatenate((self.numbers, other.numbers)),
            np.concatenate((self.unseen_s, other.unseen_s)),
        )


class ByteTracker:
    """Tracks the objects of one camera.

    `ids` gives the number of each new track, above 0; trackers that share it never give the same one.
    `counts` are continued. Raises ValueError when scipy is not installed.
    """

    def __init__(self, ids: Iterator[int], counts: StampCounts | None = None) -> None:
        self._solver = load_solver()
        self._ids = ids
        self._counts = counts or StampCounts()
        self._tracks = Tracks.none()
        self._common = CommonMotion()
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
        self._common = CommonMotion()
        self._stamp_s = -math.inf

    def is_late(self, stamp_s: float) -> bool:
        """Whether `update` will leave an image of this stamp out, as a newer one has been tracked."""
        return 0 < self._stamp_s - stamp_s <= MAX_LATE_S

    def update(
        self,
        detections: Detections,
        *,
        stamp_s: float,
        settings: TrackerSettings,
        camera: Similarity | None = None,
    ) -> tuple[str, ...]:
        """The id of each of the `detections` in the next image; "" for one without a confirmed track.

        `camera` maps pixels of the last image to those of this one, if it is known to have moved.

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
        tracks = self._with_common(tracks, detections, step_s, settings)
        rows, columns = _associated(tracks, detections, settings, self._solver)
        numbers = np.full(len(detections), UNCONFIRMED, np.int64)
        numbers[columns] = [number or next(self._ids) for number in tracks.numbers[rows].tolist()]
        seen = tracks.at(rows).seen(detections, columns, numbers[columns], step_s)
        lost = tracks.at(_without(np.flatnonzero(tracks.is_confirmed), rows))
        self._tracks = _latest(seen.followed_by(self._begun(detections, columns, settings)).followed_by(lost))
        self._stamp_s = stamp_s
        return tuple(str(number) if number else "" for number in numbers.tolist())

    def _with_common(
        self, tracks: Tracks, detections: Detections, step_s: float, settings: TrackerSettings
    ) -> Tracks:
        """The `tracks` after what those seen lately have in common is known."""
        if not len(tracks):
            self._common = CommonMotion()
            return tracks
        size_px = tracks.motion.usual_size_px
        self._common.predict(step_s, size_px)
        recent = tracks.is_confirmed & (tracks.unseen_s <= step_s + _RECENT_S)
        leading = tracks.at(np.flatnonzero(recent)[:_LEADING])
        high = np.flatnonzero(detections.scores[:_LEADING] >= settings.track_high_threshold)
        similarity = _similarity(leading, detections, len(high), settings, self._common.variance_xy)
        everyone = np.arange(len(leading))
        rows, columns = best_pairs(similarity, everyone, high, settings.track_match_threshold, self._solver)
        seen_xy = xyxy_to_cxcywh(detections.boxes_xyxy[columns])[:, :2]
        correction = self._common.correct(leading.motion.position[rows, :2], seen_xy, size_px)
        return (
            tracks if correction is None else tracks.seen_from(correction.similarity, correction.velocity_xy)
        )

    def _begun(self, detections: Detections, taken: Indices, settings: TrackerSettings) -> Tracks:
        """Tracks of the detections of a high score that are not `taken`."""
        high = np.flatnonzero(detections.scores[:MAX_DETECTIONS] >= settings.track_high_threshold)
        return Tracks.started(detections, _without(high, taken))


def _latest(tracks: Tracks) -> Tracks:
    """At most MAX_TRACKS tracks, those seen last."""
    if len(tracks) <= MAX_TRACKS:
        return tracks
    return tracks.at(np.sort(np.argsort(tracks.unseen_s, kind="stable")[:MAX_TRACKS]))


def _associated(
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
    second = best_pairs(similarity, _without(confirmed, first[0]), low, threshold, solver)
    third = best_pairs(similarity, unconfirmed, _without(high, first[1]), threshold, solver)
    rows, columns = zip(first, second, third, strict=True)
    return np.concatenate(rows), np.concatenate(columns)


def _without(indices: Indices, removed: Indices) -> Indices:
    """`indices` that are not in `removed`."""
    return indices[~np.isin(indices, removed)]


def _similarity(
    tracks: Tracks,
    detections: Detections,
    count: int,
    settings: TrackerSettings,
    common_variance_xy: Array | float = 0.0,
) -> NDArray[np.float64]:
    """IoU (n, count) of the tracks with the first `count` detections; 0 where the classes differ.

    Between two images of a slow camera an object may leave its predicted box, so boxes are compared with a
    margin, as in C-BIoU (Yang et al. 2023): the uncertainty of the prediction, which is small at 30 Hz.
    """
    motion = tracks.motion
    margin_xy = motion.margin_xy(common_variance_xy)
    similarity = iou_matrix(motion.boxes_xyxy, detections.boxes_xyxy[:count], margin_xy)
    if not settings.track_across_classes:
        similarity[tracks.class_ids[:, None] != detections.class_ids[:count]] = 0
    return similarity
