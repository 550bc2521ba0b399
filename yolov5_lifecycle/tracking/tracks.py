"""The tracks of one camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.tracking.assignment import Indices
from yolov5_lifecycle.tracking.motion import Array, Motion, Similarity

UNCONFIRMED = 0
"""The number of a track that was seen once."""


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
