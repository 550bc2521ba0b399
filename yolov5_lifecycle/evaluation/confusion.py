"""The confusion matrix: what each object was detected as."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.evaluated import EvaluatedImage
from yolov5_lifecycle.evaluation.matching import MAX_DETECTIONS, Matches

MIN_IOU = 0.5


def confusion_matrix(
    images: Sequence[EvaluatedImage], matches: Matches, thresholds: NDArray[np.float64]
) -> NDArray[np.int64]:
    """(classes + 1, classes + 1) numbers of objects by true class, a row each, and detected class.

    The last column has the objects that were missed, the last row the detections without an object.
    Objects are first matched with detections of their own class, so the diagonal has the right detections of
    the table; then the rest are matched with one another, highest IoU first.
    """
    class_count = len(matches.classes)
    counts = np.zeros((class_count + 1, class_count + 1), np.int64)
    for image, (own, crowded) in enumerate(_rows_by_image(matches, len(images))):
        _add(counts, images[image], own, crowded, thresholds)
    return counts


def occurring(
    counts: NDArray[np.int64], class_names: Sequence[str]
) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """The matrix without classes that have neither objects nor detections, and the names of the others."""
    is_there = (counts.sum(axis=0) + counts.sum(axis=1))[:-1] > 0
    kept = [*np.flatnonzero(is_there).tolist(), len(class_names)]
    return counts[np.ix_(kept, kept)], tuple(class_names[class_id] for class_id in kept[:-1])


def _rows_by_image(matches: Matches, count: int) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """For each image the pairs (p, 2) of detection and object of one class, and the ignored detections."""
    pairs = np.concatenate([one.pairs for one in matches.classes])
    crowded = np.concatenate([one.crowded for one in matches.classes])
    pairs, crowded = pairs[np.argsort(pairs[:, 0])], crowded[np.argsort(crowded[:, 0])]
    images = np.arange(count + 1)
    of_pairs, of_crowded = np.searchsorted(pairs[:, 0], images), np.searchsorted(crowded[:, 0], images)
    return [
        (
            pairs[of_pairs[image] : of_pairs[image + 1], 1:],
            crowded[of_crowded[image] : of_crowded[image + 1], 1],
        )
        for image in range(count)
    ]


def _add(
    counts: NDArray[np.int64],
    image: EvaluatedImage,
    own: NDArray[np.int64],
    crowded: NDArray[np.int64],
    thresholds: NDArray[np.float64],
) -> None:
    """Add the detections and objects of one image to `counts`, in place."""
    found, truth, background = image.found, image.truth, len(counts) - 1
    is_free = found.scores > thresholds[found.class_ids]
    for class_id in np.unique(found.class_ids):  # COCO ignores the rest
        is_free[np.flatnonzero(found.class_ids == class_id)[MAX_DETECTIONS:]] = False
    is_free[crowded] = False
    is_missed = ~truth.is_crowd
    for row, target in own.tolist():
        if is_free[row]:
            counts[truth.class_ids[target], found.class_ids[row]] += 1
            is_free[row], is_missed[target] = False, False
    rows, targets = np.flatnonzero(is_free), np.flatnonzero(is_missed)
    for row, target in _overlapping(found.xyxy[rows], truth.xyxy[targets]):
        if is_free[rows[row]] and is_missed[targets[target]]:
            counts[truth.class_ids[targets[target]], found.class_ids[rows[row]]] += 1
            is_free[rows[row]], is_missed[targets[target]] = False, False
    counts[background] += np.bincount(found.class_ids[is_free], minlength=len(counts))
    counts[:, background] += np.bincount(truth.class_ids[is_missed], minlength=len(counts))


def _overlapping(boxes_xyxy: NDArray[np.float64], others_xyxy: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Pairs of rows with an IoU of at least MIN_IOU, the highest first."""
    if not len(boxes_xyxy) or not len(others_xyxy):
        return []
    from pycocotools import mask as coco

    iou = np.asarray(coco.iou(_xywh(boxes_xyxy), _xywh(others_xyxy), [0] * len(others_xyxy)))
    rows, targets = np.nonzero(iou >= MIN_IOU)
    order = np.argsort(-iou[rows, targets], kind="stable")
    return list(zip(rows[order].tolist(), targets[order].tolist(), strict=True))


def _xywh(boxes_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate((boxes_xyxy[:, :2], boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]), axis=1)
