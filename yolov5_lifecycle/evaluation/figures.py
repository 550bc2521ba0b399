"""Precision, recall and F1 at confidence thresholds, the confusion matrix, and a bootstrap over the images.

The bootstrap tells how much figures would vary with other images. They are computed for 1,000 samples, each
of as many images as there are, drawn with replacement. An image that is drawn twice counts twice. Detections
are matched within their image, so this needs no new matching: the right and wrong detections of an image are
weighted with how often it was drawn. Up to rounding, the result is that of pycocotools for the drawn images.
Two models are evaluated on the same draws: what an image contributes to both, such as being difficult,
cancels in the difference.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.ground_truth import Boxes
from yolov5_lifecycle.evaluation.matching import EvaluatedImage, Matches, match

METRICS = ("precision", "recall", "f1", "ap50", "ap50_95")
MIN_IOU = 0.5
RESAMPLES = 1000
SEED = 20_240_229
SHARE = 0.95
"""Share of the resamples that lie within an interval."""
MIN_IMAGES = 10
"""With fewer images there is no verdict."""
_RECALLS = np.linspace(0.0, 1.00, int(np.round((1.00 - 0.0) / 0.01)) + 1, endpoint=True)
"""As in pycocotools."""
MAX_ELEMENTS = 4_000_000
"""Maximum size of an array: resamples are computed in portions."""
_TINY = np.spacing(1)


@dataclass(frozen=True, eq=False)
class Counts:
    """Numbers of right and wrong detections, and of the objects that there are: arrays that broadcast."""

    right: NDArray[np.int64]
    wrong: NDArray[np.int64]
    objects: NDArray[np.int64]

    @property
    def precision(self) -> NDArray[np.float64]:
        """Share of the detections that are right; NaN without detections."""
        return share(self.right, self.right + self.wrong)

    @property
    def recall(self) -> NDArray[np.float64]:
        """Share of the objects that were found; NaN without objects."""
        return share(self.right, self.objects)

    @property
    def f1(self) -> NDArray[np.float64]:
        """Harmonic mean of precision and recall; 0 if nothing was found, NaN without objects."""
        return share(2 * self.right, np.where(self.objects > 0, self.right + self.wrong + self.objects, 0))


def share(part: NDArray[np.number], whole: NDArray[np.number]) -> NDArray[np.float64]:
    """`part` of `whole`; NaN where that is 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(whole > 0, np.divide(part, whole), np.nan)


def mean_of_classes(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the last axis, of the classes that have objects; NaN if none has."""
    known = np.isfinite(values)
    return share(np.where(known, values, 0).sum(axis=-1), known.sum(axis=-1))


def rows(matches: Matches, thresholds: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Counts and METRICS of all classes together, then of each, at its confidence threshold and IoU 0.5.

    `images` are those with such an object; NaN where there is no figure. Together: precision, recall and F1
    of all detections and objects; the mean of the average precisions of the classes that have objects.
    """
    counts = counts_at(matches, thresholds)
    is_present = matches.objects > 0
    images = [is_present.any(axis=0).sum(), *is_present.sum(axis=1)]
    figures = by_metric(counts, matches.ap50[None], matches.ap50_95[None])
    return [
        {
            "name": name,
            "images": int(images[place]),
            "objects": int(counts.objects[0, place]),
            "right": int(counts.right[0, place]),
            "wrong": int(counts.wrong[0, place]),
            "missed": int(counts.objects[0, place] - counts.right[0, place]),
            **{metric: float(values[0, place]) for metric, values in figures.items()},
        }
        for place, name in enumerate(("all", *matches.class_names))
    ]


def counts_at(
    matches: Matches, thresholds: NDArray[np.float64], weights: NDArray[np.int32] | None = None
) -> Counts:
    """Counts (r, 1 + classes) of the detections above the threshold of their class, at IoU 0.5.

    All classes together, then each; for each row of `weights` (r, images), how often an image counts. None:
    once, r = 1.
    """
    drawn = np.ones((1, matches.objects.shape[1]), np.int32) if weights is None else weights
    is_above = matches.scores > thresholds[matches.class_ids]
    is_right, is_ignored = matches.is_right[0], matches.is_ignored[0]
    counted = (is_above & is_right, is_above & ~is_right & ~is_ignored)
    per_image: tuple[Iterable[NDArray[np.int64]], ...] = (
        *(_by_image(matches, each) for each in counted),
        matches.objects,
    )
    each = (np.stack([drawn @ of_class for of_class in classes], axis=1) for classes in per_image)
    return Counts(*(np.column_stack((of_classes.sum(axis=1), of_classes)) for of_classes in each))


def _by_image(matches: Matches, is_counted: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """For each class the number of such detections in each image."""
    slices = map(matches.of_class, range(len(matches.class_names)))
    count = matches.objects.shape[1]
    return [np.bincount(matches.images[rows][is_counted[rows]], minlength=count) for rows in slices]


def by_metric(
    counts: Counts, ap50: NDArray[np.float64], ap50_95: NDArray[np.float64]
) -> dict[str, NDArray[np.float64]]:
    """By METRICS (r, 1 + classes) from `counts` of that shape and average precisions (r, classes)."""
    averages = [np.column_stack((mean_of_classes(values), values)) for values in (ap50, ap50_95)]
    return dict(zip(METRICS, (counts.precision, counts.recall, counts.f1, *averages), strict=True))


def sweep(matches: Matches, class_id: int | None = None) -> tuple[NDArray[np.float64], Counts]:
    """Distinct scores (s,), descending, and the counts of the detections with at least each, at IoU 0.5.

    Of a class, or of all together.
    """
    rows = slice(None) if class_id is None else matches.of_class(class_id)
    order = np.argsort(-matches.scores[rows], kind="stable")
    scores, is_right = matches.scores[rows][order], matches.is_right[0, rows][order]
    is_wrong = ~is_right & ~matches.is_ignored[0, rows][order]
    is_last = np.append(scores[1:] < scores[:-1], True)[: len(scores)]
    objects = matches.objects[slice(None) if class_id is None else class_id].sum()
    return scores[is_last], Counts(np.cumsum(is_right)[is_last], np.cumsum(is_wrong)[is_last], objects)


def confusion_matrix(
    images: Sequence[EvaluatedImage], matches: Matches, thresholds: NDArray[np.float64]
) -> NDArray[np.int64]:
    """(classes + 1, classes + 1) numbers of objects by true class, a row each, and detected class.

    The last column has the objects that were missed, the last row the detections without an object.
    Objects are first matched with detections of their own class, so the diagonal has the right detections of
    the table; then the rest are matched with one another as if they had one class.
    """
    is_above = matches.scores > thresholds[matches.class_ids]
    is_right = is_above & matches.is_right[0]
    is_free = np.zeros(len(matches.rows), np.bool_)
    is_free[matches.rows] = is_above & ~is_right & ~matches.is_ignored[0]
    is_missed = np.concatenate([~image.truth.is_crowd for image in images])
    is_missed[matches.targets[is_right]] = False
    free = np.split(is_free, np.cumsum([len(image.found) for image in images])[:-1])
    missed = np.split(is_missed, np.cumsum([len(image.truth) for image in images])[:-1])
    pairs = match(list(map(_rest, images, free, missed)), ("any",))
    rows, targets = pairs.rows[pairs.is_right[0]], pairs.targets[pairs.is_right[0]]
    found_ids = np.concatenate([image.found.class_ids for image in images])[is_free]
    missed_ids = np.concatenate([image.truth.class_ids for image in images])[is_missed]
    size = len(matches.class_names) + 1
    counts = np.diag(np.bincount(matches.class_ids[is_right], minlength=size))
    np.add.at(counts, (missed_ids[targets], found_ids[rows]), 1)
    counts[-1] += np.bincount(np.delete(found_ids, rows), minlength=size)
    counts[:, -1] += np.bincount(np.delete(missed_ids, targets), minlength=size)
    return counts


def occurring(
    counts: NDArray[np.int64], class_names: Sequence[str]
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """The matrix without classes that have neither objects nor detections, and the names of the others."""
    is_there = (counts.sum(axis=0) + counts.sum(axis=1))[:-1] > 0
    kept = [*np.flatnonzero(is_there).tolist(), len(class_names)]
    return counts[np.ix_(kept, kept)], tuple(class_names[class_id] for class_id in kept[:-1])


def _rest(image: EvaluatedImage, is_free: NDArray[np.bool_], is_missed: NDArray[np.bool_]) -> EvaluatedImage:
    """The detections `is_free` and objects `is_missed` of an image, all of one class."""
    found, xyxy = image.found[is_free], image.truth.xyxy[is_missed]
    truth = Boxes(xyxy, np.zeros(len(xyxy), np.int64), np.zeros(len(xyxy), np.bool_))
    return replace(image, truth=truth, found=replace(found, class_ids=np.zeros(len(found), np.int64)))


@dataclass(frozen=True)
class Interval:
    """A figure of both models, and the interval of the second minus the first."""

    first: float
    second: float
    difference_low: float
    difference_high: float
    verdict: str | None
    """`better`, `worse`, `no difference shown`, `too few images`, or None if one has no such figure."""


def drawn_weights(image_count: int, resamples: int = RESAMPLES) -> NDArray[np.int32]:
    """(resamples, images): how often each image is drawn, the same in every run."""
    shares = np.full(image_count, 1 / image_count)
    return np.random.default_rng(SEED).multinomial(image_count, shares, size=resamples).astype(np.int32)


def resampled(
    matches: Matches, thresholds: NDArray[np.float64], weights: NDArray[np.int32]
) -> dict[str, NDArray[np.float64]]:
    """By metric (r, 1 + classes) for the rows of `weights`: all classes together, then each; NaN without."""
    each = [_average_precisions(matches, number, weights) for number in range(len(matches.class_names))]
    ap50, ap50_95 = np.stack(each, axis=2)
    return by_metric(counts_at(matches, thresholds, weights), ap50, ap50_95)


def differences(
    matches: Sequence[Matches], thresholds: Sequence[NDArray[np.float64]]
) -> list[dict[str, Interval]]:
    """By metric the interval of all classes together, then of each; for both models."""
    weights = drawn_weights(matches[0].objects.shape[1])
    one, other = (resampled(*pair, weights) for pair in zip(matches, thresholds, strict=True))
    figures = zip(*map(rows, matches, thresholds), strict=True)
    return [
        {
            name: interval(
                (one[name][:, number], other[name][:, number]),
                (row[name], row_of_other[name]),
                weights.shape[1],
            )
            for name in METRICS
        }
        for number, (row, row_of_other) in enumerate(figures)
    ]


def interval(
    samples: tuple[NDArray[np.float64], NDArray[np.float64]],
    figures: tuple[float, float],
    image_count: int,
) -> Interval:
    """Interval of the difference from resamples (r,) of both models."""
    differences = samples[1] - samples[0]
    known = differences[np.isfinite(differences)]
    if not len(known) or not np.isfinite(figures).all():
        return Interval(*figures, float("nan"), float("nan"), None)
    low, high = np.quantile(known, ((1 - SHARE) / 2, (1 + SHARE) / 2)).tolist()
    verdict = "better" if low > 0 else "worse" if high < 0 else "no difference shown"
    return Interval(*figures, low, high, verdict if image_count >= MIN_IMAGES else "too few images")


def _average_precisions(
    matches: Matches, class_id: int, weights: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Average precisions (r,) of a class at IoU 0.5, and in the mean of all IoU thresholds."""
    of_class = matches.of_class(class_id)
    images, is_right = matches.images[of_class], matches.is_right[:, of_class]
    is_ignored = matches.is_ignored[:, of_class]
    found = np.empty((len(weights), len(is_right)), np.float64)
    size = max(MAX_ELEMENTS // max(len(images), 1), 1)
    for portion in (slice(start, start + size) for start in range(0, len(weights), size)):
        # Detections first: sums over them run along whole rows, which is ten times faster.
        drawn = np.ascontiguousarray(weights[portion].T)[images]  # (d, r)
        objects = (weights[portion] @ matches.objects[class_id]).astype(np.float64)
        all_of = np.cumsum(drawn, axis=0, dtype=np.int32)
        for level, (right, ignored) in enumerate(zip(is_right, is_ignored, strict=True)):
            counted = all_of
            if ignored.any():
                counted = np.cumsum(drawn * ~ignored[:, None], axis=0, dtype=np.int32)
            found[portion, level] = _average_precision(drawn[right], counted[right], objects)
    return found[:, 0], found.mean(axis=1)


def _average_precision(
    right: NDArray[np.int32], counted: NDArray[np.int32], objects: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Average precision (r,) of resamples; NaN without objects.

    `right` (p, r): the weight of each right detection, best first; `counted` (p, r): that of all detections
    up to there. Between right detections recall stays and precision falls, so nothing else matters.
    """
    hits = np.cumsum(right, axis=0, dtype=np.int32)
    best = np.maximum.accumulate((hits / (counted + _TINY))[::-1], axis=0)[::-1]
    # A recall that pycocotools asks for counts at the first detection that reaches it.
    reached = np.searchsorted(_RECALLS, share(hits, objects), side="right")
    steps = np.diff(reached, axis=0, prepend=0)
    return np.where(objects > 0, (best * steps).sum(axis=0) / len(_RECALLS), np.nan)
