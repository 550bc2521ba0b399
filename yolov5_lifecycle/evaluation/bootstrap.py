"""How much figures would vary with other images: a paired bootstrap over the images.

The figures are computed for 1,000 samples, each of as many images as there are, drawn with replacement. An
image that is drawn twice counts twice. Detections are matched within their image, so this needs no new
matching: the right and wrong detections of an image are weighted with how often it was drawn. Up to rounding,
the result is that of pycocotools for the drawn images. Two models are evaluated on the same draws: what an
image contributes to both, such as being difficult, cancels in the difference.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.figures import METRICS, Row
from yolov5_lifecycle.evaluation.matching import ClassMatches, Matches

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


@dataclass(frozen=True)
class Interval:
    """A figure of both models, and the interval of the second minus the first."""

    first: float
    second: float
    low: float
    high: float
    verdict: str
    """`better`, `worse`, `no difference shown`, `too few images`, or "" if one has no such figure."""


Samples = Mapping[str, NDArray[np.float64]]
"""By metric, (resamples, 1 + classes): all classes together, then each; NaN without objects."""


def drawn_weights(image_count: int, resamples: int = RESAMPLES) -> NDArray[np.int32]:
    """(resamples, images): how often each image is drawn, the same in every run."""
    rng = np.random.default_rng(SEED)
    shares = np.full(image_count, 1 / image_count)
    return rng.multinomial(image_count, shares, size=resamples).astype(np.int32)


def resampled(
    matches: Matches, thresholds: NDArray[np.float64], weights: NDArray[np.int32]
) -> dict[str, NDArray[np.float64]]:
    """The figures for each row of `weights`, at the confidence threshold of each class."""
    classes = [
        _resampled_class(one, threshold, weights)
        for one, threshold in zip(matches.classes, thresholds.tolist(), strict=True)
    ]
    right, wrong, objects = (
        np.stack([one[name] for one in classes], axis=1) for name in ("right", "wrong", "objects")
    )
    right, wrong, objects = (
        np.concatenate((values.sum(axis=1, keepdims=True), values), axis=1)
        for values in (right, wrong, objects)
    )
    samples = {
        "precision": _divided(right, right + wrong),
        "recall": _divided(right, objects),
        "f1": np.where(objects > 0, _divided(2 * right, right + wrong + objects), np.nan),
    }
    for name in ("ap50", "ap50_95"):
        values = np.stack([one[name] for one in classes], axis=1)
        samples[name] = np.concatenate((_mean_of_classes(values)[:, None], values), axis=1)
    return samples


def differences(
    first: Samples, second: Samples, rows: Sequence[tuple[Row, Row]], image_count: int
) -> list[dict[str, Interval]]:
    """By metric the interval of each pair of `rows`: all classes together, then each."""
    return [
        {
            name: interval(
                first[name][:, number],
                second[name][:, number],
                one.figures[name],
                other.figures[name],
                image_count,
            )
            for name in METRICS
        }
        for number, (one, other) in enumerate(rows)
    ]


def interval(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    first_figure: float,
    second_figure: float,
    image_count: int,
    *,
    margin: float = 0.0,
) -> Interval:
    """Interval of the difference from resamples (r,) of both models, and whether it exceeds `margin`."""
    differences = second - first
    known = differences[np.isfinite(differences)]
    if not len(known) or not np.isfinite(second_figure - first_figure):
        return Interval(first_figure, second_figure, float("nan"), float("nan"), "")
    low, high = np.quantile(known, ((1 - SHARE) / 2, (1 + SHARE) / 2)).tolist()
    return Interval(first_figure, second_figure, low, high, _verdict(low, high, image_count, margin))


def _verdict(low: float, high: float, image_count: int, margin: float) -> str:
    if image_count < MIN_IMAGES:
        return "too few images"
    return "better" if low > margin else "worse" if high < -margin else "no difference shown"


def _resampled_class(
    matches: ClassMatches, threshold: float, weights: NDArray[np.int32]
) -> dict[str, NDArray[np.float64]]:
    """Counts at the threshold and average precisions of one class, each (resamples,)."""
    is_right, is_ignored = matches.is_right[0], matches.is_ignored[0]
    above = matches.scores > threshold
    count = len(matches.objects)
    right = np.bincount(matches.images[above & is_right], minlength=count)
    wrong = np.bincount(matches.images[above & ~is_right & ~is_ignored], minlength=count)
    precision = _average_precisions(matches, weights)
    return {
        "right": (weights @ right).astype(np.float64),
        "wrong": (weights @ wrong).astype(np.float64),
        "objects": (weights @ matches.objects).astype(np.float64),
        "ap50": precision[:, 0],
        "ap50_95": precision.mean(axis=1),
    }


def _average_precisions(matches: ClassMatches, weights: NDArray[np.int32]) -> NDArray[np.float64]:
    """(resamples, 10): the average precision at each IoU threshold; NaN without objects."""
    found = np.empty((len(weights), 10), np.float64)
    for rows in _portions(len(weights), len(matches.scores)):
        # Detections first: sums over them run along whole rows, which is ten times faster.
        drawn = np.ascontiguousarray(weights[rows].T)[matches.images]  # (d, r)
        objects = (weights[rows] @ matches.objects).astype(np.float64)
        all_of = np.cumsum(drawn, axis=0, dtype=np.int32)
        for level in range(10):
            is_right, ignored = matches.is_right[level], matches.is_ignored[level]
            counted = all_of
            if ignored.any():
                counted = np.cumsum(drawn * ~ignored[:, None], axis=0, dtype=np.int32)
            found[rows, level] = _average_precision(drawn[is_right], counted[is_right], objects)
    return found


def _average_precision(
    right: NDArray[np.int32], counted: NDArray[np.int32], objects: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Average precision (r,) of resamples.

    `right` (p, r): the weight of each right detection, best first; `counted` (p, r): that of all detections
    up to there. Between right detections recall stays and precision falls, so nothing else matters.
    """
    hits = np.cumsum(right, axis=0, dtype=np.int32)
    precision = hits / (counted + _TINY)
    best = np.maximum.accumulate(precision[::-1], axis=0)[::-1]
    with np.errstate(invalid="ignore", divide="ignore"):
        recall = hits / objects
    # A recall that pycocotools asks for counts at the first detection that reaches it.
    reached = np.searchsorted(_RECALLS, recall, side="right")
    steps = np.diff(reached, axis=0, prepend=0)
    average: NDArray[np.float64] = (best * steps).sum(axis=0) / len(_RECALLS)
    return np.where(objects > 0, average, np.nan)


def _portions(resamples: int, detections: int) -> Iterator[slice]:
    size = max(MAX_ELEMENTS // max(detections, 1), 1)
    return (slice(start, start + size) for start in range(0, resamples, size))


def _divided(part: NDArray[np.float64], whole: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(whole > 0, part / whole, np.nan), np.float64)


def _mean_of_classes(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over the classes (r, classes) that have objects; NaN if none has."""
    known = np.isfinite(values)
    return _divided(np.where(known, values, 0).sum(axis=1), known.sum(axis=1).astype(np.float64))
