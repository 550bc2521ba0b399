"""How well tracks keep identities: IDF1 and identity switches.

IDF1: Ristani et al., "Performance Measures and a Data Set for Multi-Target, Multi-Camera Tracking" (2016).
Identity switches: Bernardin and Stiefelhagen, "Evaluating Multiple Object Tracking Performance" (2008).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from yolov5_lifecycle.tracking.assignment import iou_matrix

MIN_IOU = 0.5
"""Of a track's box and a true one, for IDF1 and switches."""
_TINY = 1e-9  # a box of exactly the minimum IoU counts


@dataclass(frozen=True, eq=False)
class JudgedFrame:
    """True objects and tracked ones of an image, each identity at most once."""

    truth_ids: Sequence[int]
    truth_boxes_xyxy: NDArray[np.float32]
    track_ids: Sequence[str]
    track_boxes_xyxy: NDArray[np.float32]


@dataclass(frozen=True)
class TrackCounts:
    """Counts from which the figures are computed; those of several recordings add up."""

    truths: int = 0
    """True boxes."""
    tracked: int = 0
    """Boxes with an id."""
    identified: int = 0
    """True boxes whose track is the best match of this identity, one to one."""
    switches: int = 0
    """How often an object continues with another id."""

    def __add__(self, other: TrackCounts) -> TrackCounts:
        return TrackCounts(
            self.truths + other.truths,
            self.tracked + other.tracked,
            self.identified + other.identified,
            self.switches + other.switches,
        )

    @property
    def idf1(self) -> float:
        """In [0, 1]; 1 without any box."""
        boxes = self.truths + self.tracked
        return 2 * self.identified / boxes if boxes else 1.0


@dataclass(frozen=True, eq=False)
class _Overlap:
    """A frame whose identities are numbers from 0."""

    truths: NDArray[np.intp]
    tracks: NDArray[np.intp]
    iou: NDArray[np.float64]
    """(truths, tracks)."""

    def together(self, shape: tuple[int, int]) -> NDArray[np.float64]:
        """(all truths, all tracks): 1 where a pair overlaps by at least MIN_IOU."""
        counts = np.zeros(shape)
        counts[np.ix_(self.truths, self.tracks)] = self.iou >= MIN_IOU - _TINY
        return counts


def track_counts(frames: Sequence[JudgedFrame]) -> TrackCounts:
    """The counts of one recording."""
    truth_numbers = _numbers(name for frame in frames for name in frame.truth_ids)
    track_numbers = _numbers(name for frame in frames for name in frame.track_ids)
    overlaps = [
        _Overlap(
            np.array([truth_numbers[name] for name in frame.truth_ids], np.intp),
            np.array([track_numbers[name] for name in frame.track_ids], np.intp),
            iou_matrix(frame.truth_boxes_xyxy, frame.track_boxes_xyxy),
        )
        for frame in frames
    ]
    shape = len(truth_numbers), len(track_numbers)
    return TrackCounts(
        truths=sum(len(overlap.truths) for overlap in overlaps),
        tracked=sum(len(overlap.tracks) for overlap in overlaps),
        identified=_identified(overlaps, shape),
        switches=_switches(overlaps),
    )


def _numbers(names: Iterable[Hashable]) -> dict[Hashable, int]:
    return {name: number for number, name in enumerate(dict.fromkeys(names))}


def _identified(overlaps: Iterable[_Overlap], shape: tuple[int, int]) -> int:
    together = sum((overlap.together(shape) for overlap in overlaps), np.zeros(shape))
    return int(together[linear_sum_assignment(together, maximize=True)].sum())


def _switches(overlaps: Iterable[_Overlap]) -> int:
    """Pairs of the previous frame continue while they overlap; the others are matched by IoU."""
    last: dict[int, int] = {}  # truth -> its track, also while the object is not seen
    switches = 0
    for overlap in overlaps:
        gated = np.where(overlap.iou >= MIN_IOU - _TINY, overlap.iou, 0)
        before = np.array([last.get(truth, -1) for truth in overlap.truths.tolist()], np.intp)
        gated += 2 * ((overlap.tracks == before[:, None]) & (gated > 0))  # more than any other pair has
        for row, column in zip(*linear_sum_assignment(gated, maximize=True), strict=True):
            if gated[row, column] > 0:
                truth, track = int(overlap.truths[row]), int(overlap.tracks[column])
                switches += last.get(truth, track) != track
                last[truth] = track
    return switches
