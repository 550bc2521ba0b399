"""Detections matched with the ground truth by pycocotools, and its average precision."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.evaluation.evaluated import EvaluatedImage

MAX_DETECTIONS = 100
"""Only this many of the best detections per image and class count, as in COCO's evaluation."""
_ANY_AREA = [0, 1e10]


@dataclass(frozen=True, eq=False)
class ClassMatches:
    """Detections of a class in all images, highest score first, and whether each is right."""

    scores: NDArray[np.float64]
    """(d,)."""
    images: NDArray[np.int64]
    """(d,) indices of images."""
    is_right: NDArray[np.bool_]
    """(10, d): it matches an object, at each of the 10 IoU thresholds from 0.5 to 0.95."""
    is_ignored: NDArray[np.bool_]
    """(10, d): it is in a crowd, and neither right nor wrong."""
    objects: NDArray[np.int64]
    """(images,) number of objects in each image, without crowds."""
    pairs: NDArray[np.int64]
    """(p, 3) image, row of the detection and row of the object, for those that match at IoU 0.5."""
    crowded: NDArray[np.int64]
    """(c, 2) image and row of the detections that are ignored at IoU 0.5."""


@dataclass(frozen=True, eq=False)
class Matches:
    """The matches of each class, and pycocotools' average precision."""

    classes: tuple[ClassMatches, ...]
    precision: NDArray[np.float64]
    """(10, 101, classes): the best precision at a recall of at least 0, 0.01, ..., 1; -1 without objects."""

    @property
    def ap50(self) -> NDArray[np.float64]:
        """(classes,) average precision at IoU 0.5; NaN for a class without objects."""
        return _average(self.precision[:1])

    @property
    def ap50_95(self) -> NDArray[np.float64]:
        """(classes,) average precision, mean of IoU 0.5 to 0.95; NaN for a class without objects."""
        return _average(self.precision)


def mean_of_classes(values: NDArray[np.float64]) -> float:
    """The mean over the classes that have objects; NaN if none has."""
    return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else float("nan")


def match(images: Sequence[EvaluatedImage], class_names: Sequence[str]) -> Matches:
    """Match the detections in `images` with their ground truth, class by class."""
    truth, found = truth_dataset(images, class_names), found_annotations(images)
    evaluation = evaluated_by_coco(truth, found)
    row_of_object = _rows(truth["annotations"])
    row_of_detection = _rows(found)
    classes = []
    for class_id in range(len(class_names)):
        # One area range: the results are sorted by class, then by image.
        results = evaluation.evalImgs[class_id * len(images) : (class_id + 1) * len(images)]
        classes.append(_class_matches(results, row_of_object, row_of_detection))
    return Matches(tuple(classes), np.asarray(evaluation.eval["precision"][:, :, :, 0, 0], np.float64))


def evaluated_by_coco(truth: dict[str, Any], found: list[dict[str, Any]]) -> Any:
    """COCOeval of the data set `truth` with the detections `found`, accumulated."""
    from pycocotools.cocoeval import COCOeval

    with contextlib.redirect_stdout(io.StringIO()):
        evaluation = COCOeval(_indexed(truth), _indexed({**truth, "annotations": found}), "bbox")
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [_ANY_AREA], ["all"]
        evaluation.params.maxDets = [MAX_DETECTIONS]
        evaluation.evaluate()
        evaluation.accumulate()
    return evaluation


def truth_dataset(images: Sequence[EvaluatedImage], class_names: Sequence[str]) -> dict[str, Any]:
    """The ground truth in COCO's format; ids count from 1, boxes are x, y, width and height in pixels."""
    annotations = [
        {**_annotation(number, class_id, box), "iscrowd": int(is_crowd), "row": row}
        for number, image in enumerate(images, start=1)
        for row, (box, class_id, is_crowd) in enumerate(
            zip(
                image.truth.xyxy.tolist(),
                image.truth.class_ids.tolist(),
                image.truth.is_crowd.tolist(),
                strict=True,
            )
        )
    ]
    return {
        "images": [
            {"id": number, "file_name": image.label, "height": image.size_hw[0], "width": image.size_hw[1]}
            for number, image in enumerate(images, start=1)
        ],
        "annotations": _numbered(annotations),
        "categories": [{"id": number, "name": name} for number, name in enumerate(class_names, start=1)],
    }


def found_annotations(images: Sequence[EvaluatedImage]) -> list[dict[str, Any]]:
    """The detections in COCO's format, the MAX_DETECTIONS best of each image and class."""
    annotations = []
    for number, image in enumerate(images, start=1):
        for row in _best_rows(image.found.class_ids):
            box, class_id = image.found.xyxy[row].tolist(), int(image.found.class_ids[row])
            score = float(image.found.scores[row])
            annotations.append(
                {**_annotation(number, class_id, box), "iscrowd": 0, "score": score, "row": row}
            )
    return _numbered(annotations)


def _best_rows(class_ids: NDArray[np.int64]) -> list[int]:
    rows = [np.flatnonzero(class_ids == class_id)[:MAX_DETECTIONS] for class_id in np.unique(class_ids)]
    return sorted(np.concatenate(rows).tolist()) if rows else []


def _annotation(image: int, class_id: int, xyxy: Sequence[float]) -> dict[str, Any]:
    x1, y1, x2, y2 = xyxy
    width, height = x2 - x1, y2 - y1
    return {
        "image_id": image,
        "category_id": class_id + 1,
        "bbox": [x1, y1, width, height],
        "area": width * height,
    }


def _numbered(annotations: list[dict[str, Any]]) -> list[dict[str, Any]]:
    # COCOeval takes the id 0 for "no match".
    return [{"id": number, **annotation} for number, annotation in enumerate(annotations, start=1)]


def _rows(annotations: Sequence[dict[str, Any]]) -> NDArray[np.int64]:
    """The row within its image of each annotation, by id."""
    return np.array([-1, *(annotation["row"] for annotation in annotations)], np.int64)


def _indexed(dataset: dict[str, Any]) -> Any:
    from pycocotools.coco import COCO

    coco = COCO()
    coco.dataset = dataset
    coco.createIndex()
    return coco


def _class_matches(
    results: Sequence[dict[str, Any] | None],
    row_of_object: NDArray[np.int64],
    row_of_detection: NDArray[np.int64],
) -> ClassMatches:
    """COCOeval's results for one class: one per image, None without objects and detections."""
    present = [(image, result) for image, result in enumerate(results) if result is not None]
    objects = np.zeros(len(results), np.int64)
    scores, images, right, ignored = [], [], [], []
    pairs, crowded = [], []
    for image, result in present:
        objects[image] = np.count_nonzero(np.asarray(result["gtIgnore"]) == 0)
        scores.append(np.asarray(result["dtScores"], np.float64))
        images.append(np.full(len(scores[-1]), image, np.int64))
        matched = np.asarray(result["dtMatches"]).astype(np.int64)
        in_crowd = np.asarray(result["dtIgnore"], np.bool_)
        right.append((matched > 0) & ~in_crowd)
        ignored.append(in_crowd)
        rows = row_of_detection[np.array(result["dtIds"], np.int64)]
        hits = np.flatnonzero(right[-1][0])
        of_object = row_of_object[matched[0, hits]]
        pairs.append(np.stack((np.full(len(hits), image), rows[hits], of_object), axis=1))
        lost = rows[in_crowd[0]]
        crowded.append(np.stack((np.full(len(lost), image), lost), axis=1))
    all_scores = np.concatenate([*scores, np.empty(0)])
    order = np.argsort(-all_scores, kind="stable")
    return ClassMatches(
        scores=all_scores[order],
        images=np.concatenate([*images, np.empty(0, np.int64)])[order],
        is_right=np.concatenate([*right, np.empty((10, 0), np.bool_)], axis=1)[:, order],
        is_ignored=np.concatenate([*ignored, np.empty((10, 0), np.bool_)], axis=1)[:, order],
        objects=objects,
        pairs=np.concatenate([*pairs, np.empty((0, 3), np.int64)]),
        crowded=np.concatenate([*crowded, np.empty((0, 2), np.int64)]),
    )


def _average(precision: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean over IoU thresholds and recalls of each class; NaN where it is -1."""
    means: NDArray[np.float64] = precision.mean(axis=(0, 1))
    return np.where(precision[0, 0] < 0, np.nan, means)
