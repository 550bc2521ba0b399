"""Precision, recall and F1 at confidence thresholds, of single classes and of all together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.matching import ClassMatches, Matches, mean_of_classes

METRICS = ("precision", "recall", "f1", "ap50", "ap50_95")


@dataclass(frozen=True)
class Counts:
    """Detections above a threshold: right and wrong ones, and the objects that there are."""

    right: int
    wrong: int
    objects: int

    def __add__(self, other: Counts) -> Counts:
        return Counts(self.right + other.right, self.wrong + other.wrong, self.objects + other.objects)

    @property
    def precision(self) -> float:
        """Share of the detections that are right; NaN without detections."""
        return _share(self.right, self.right + self.wrong)

    @property
    def recall(self) -> float:
        """Share of the objects that were found; NaN without objects."""
        return _share(self.right, self.objects)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall; 0 if nothing was found, NaN without objects."""
        return (
            _share(2 * self.right, self.right + self.wrong + self.objects) if self.objects else float("nan")
        )


@dataclass(frozen=True)
class Row:
    """The figures of a class, or of all."""

    name: str
    images: int
    """Images with such an object."""
    counts: Counts
    ap50: float
    ap50_95: float

    @property
    def figures(self) -> dict[str, float]:
        """The figures by METRICS; NaN where there is none."""
        counts = self.counts
        return dict(
            zip(
                METRICS,
                (counts.precision, counts.recall, counts.f1, self.ap50, self.ap50_95),
                strict=True,
            )
        )


def rows(matches: Matches, class_names: Sequence[str], thresholds: NDArray[np.float64]) -> list[Row]:
    """The figures of all classes together, then of each, at its confidence threshold.

    Together: precision, recall and F1 of all detections and objects; the mean of the average precisions of
    the classes that have objects.
    """
    counts = [
        counts_at(one, threshold) for one, threshold in zip(matches.classes, thresholds.tolist(), strict=True)
    ]
    with_objects = [one.objects > 0 for one in matches.classes]
    together = Row(
        "all",
        int(np.any(with_objects, axis=0).sum()),
        sum(counts, Counts(0, 0, 0)),
        mean_of_classes(matches.ap50),
        mean_of_classes(matches.ap50_95),
    )
    return [
        together,
        *(
            Row(name, int(present.sum()), count, ap50, ap50_95)
            for name, present, count, ap50, ap50_95 in zip(
                class_names,
                with_objects,
                counts,
                matches.ap50.tolist(),
                matches.ap50_95.tolist(),
                strict=True,
            )
        ),
    ]


def counts_at(matches: ClassMatches, threshold: float) -> Counts:
    """The counts of a class for detections with a score above `threshold`, at IoU 0.5."""
    above = matches.scores > threshold
    right = matches.is_right[0] & above
    wrong = ~matches.is_right[0] & ~matches.is_ignored[0] & above
    return Counts(int(right.sum()), int(wrong.sum()), int(matches.objects.sum()))


@dataclass(frozen=True, eq=False)
class Sweep:
    """Counts of the detections with at least each score that occurs, highest first."""

    scores: NDArray[np.float64]
    """(s,) distinct scores, descending."""
    right: NDArray[np.int64]
    """(s,)."""
    wrong: NDArray[np.int64]
    """(s,)."""
    objects: int

    @property
    def precision(self) -> NDArray[np.float64]:
        """(s,); NaN where all detections are ignored."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.right / (self.right + self.wrong), np.float64)

    @property
    def recall(self) -> NDArray[np.float64]:
        """(s,); NaN without objects."""
        return np.asarray(self.right / self.objects if self.objects else np.full(len(self.right), np.nan))

    @property
    def f1(self) -> NDArray[np.float64]:
        """(s,); NaN without objects."""
        if not self.objects:
            return np.full(len(self.right), np.nan)
        return np.asarray(2 * self.right / (self.right + self.wrong + self.objects), np.float64)

    def at(self, thresholds: NDArray[np.float64]) -> NDArray[np.int64]:
        """(t,) index of the lowest score above each threshold; -1 if there is none."""
        return np.searchsorted(-self.scores, -thresholds, side="left") - 1


def sweep(classes: Sequence[ClassMatches]) -> Sweep:
    """The counts of `classes` together at IoU 0.5, for each score that occurs in them."""
    scores = np.concatenate([*(one.scores for one in classes), np.empty(0)])
    right = np.concatenate([*(one.is_right[0] for one in classes), np.empty(0, np.bool_)])
    ignored = np.concatenate([*(one.is_ignored[0] for one in classes), np.empty(0, np.bool_)])
    order = np.argsort(-scores, kind="stable")
    scores, right, ignored = scores[order], right[order], ignored[order]
    is_last = np.append(scores[1:] < scores[:-1], True)[: len(scores)]
    return Sweep(
        scores[is_last],
        np.cumsum(right)[is_last].astype(np.int64),
        np.cumsum(~right & ~ignored)[is_last].astype(np.int64),
        sum(int(one.objects.sum()) for one in classes),
    )


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
