"""How much figures would vary with other images: a paired bootstrap over the images.

The figures are computed for 1,000 samples, each of as many images as there are, drawn with replacement. An
image that is drawn twice counts twice. Detections are matched within their image, so this needs no new
matching: the right and wrong detections of an image are weighted with how often it was drawn. Up to rounding,
the result is that of pycocotools for the drawn images. Two models are evaluated on the same draws: what an
image contributes to both, such as being difficult, cancels in the difference.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.figures import METRICS, by_metric, counts_at, rows, share
from yolov5_lifecycle.evaluation.matching import Matches

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
                (row.figures[name], row_of_other.figures[name]),
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
    *,
    margin: float = 0.0,
) -> Interval:
    """Interval of the difference from resamples (r,) of both models, and whether it exceeds `margin`."""
    differences = samples[1] - samples[0]
    known = differences[np.isfinite(differences)]
    if not len(known) or not np.isfinite(figures).all():
        return Interval(*figures, float("nan"), float("nan"), None)
    low, high = np.quantile(known, ((1 - SHARE) / 2, (1 + SHARE) / 2)).tolist()
    verdict = "better" if low > margin else "worse" if high < -margin else "no difference shown"
    return Interval(*figures, low, high, verdict if image_count >= MIN_IMAGES else "too few images")


def _average_precisions(
    matches: Matches, class_id: int, weights: NDArray[np.int32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Average precisions (r,) of a class at IoU 0.5, and in the mean of all IoU thresholds."""
    of_class = matches.of_class(class_id)
    images, is_right = matches.images[of_class], matches.is_right[:, of_class]
    is_ignored = matches.is_ignored[:, of_class]
    found = np.empty((len(weights), len(is_right)), np.float64)
    for portion in _portions(len(weights), len(images)):
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


def _portions(resamples: int, detections: int) -> Iterator[slice]:
    size = max(MAX_ELEMENTS // max(detections, 1), 1)
    return (slice(start, start + size) for start in range(0, resamples, size))
