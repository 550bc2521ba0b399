"""Detections matched with the ground truth by pycocotools: one table, from which all figures follow."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.evaluation.ground_truth import Boxes, DataError
from yolov5_lifecycle.settings.suggestion import did_you_mean

MIN_CONFIDENCE = 0.001
"""Detections with a lower score are not evaluated, as in YOLOv5's own validation."""
MAX_DETECTIONS = 100
"""Only this many of the best detections per image and class count, as in COCO's evaluation."""
_MAX_SHOWN = 10
_ANY_AREA = [0, 1e10]


@dataclass(frozen=True, eq=False)
class EvaluatedClasses:
    """The classes that the data set and the models share, by name.

    `of_data` and `of_models` have the index into `names` of each of their class ids; -1: left out.
    """

    names: tuple[str, ...]
    of_data: NDArray[np.int64]
    of_models: tuple[NDArray[np.int64], ...]
    left_out: tuple[str, ...]
    """Classes of the data set that a model does not know or that its settings leave out."""

    @classmethod
    def shared(
        cls,
        data_names: Sequence[str] | None,
        models: Sequence[tuple[Sequence[str], frozenset[int] | None]],
    ) -> EvaluatedClasses:
        """The classes in `data_names` and in each of `models`: its names and selected ids (None: all).

        Without `data_names` the ids of the data set are those of the first model. Raises DataError if there
        is none.
        """
        data_names = models[0][0] if data_names is None else data_names
        wanted = [
            {name for class_id, name in enumerate(names) if chosen is None or class_id in chosen}
            for names, chosen in models
        ]
        names = tuple(dict.fromkeys(name for name in data_names if all(name in one for one in wanted)))
        if not names:
            raise DataError(_nothing_shared(data_names, models[0][0]))
        index = {name: number for number, name in enumerate(names)}
        of_data, *of_models = (
            np.array([index.get(name, -1) for name in each], np.int64)
            for each in (data_names, *(model_names for model_names, _ in models))
        )
        left_out = tuple(name for name in dict.fromkeys(data_names) if name not in index)
        return cls(names, of_data, tuple(of_models), left_out)

    def truth(self, boxes: Boxes) -> Boxes:
        """The boxes of these classes, with indices into `names`; raises DataError for unknown ids."""
        if boxes.class_ids.max(initial=0) >= len(self.of_data):
            found = int(boxes.class_ids.max())
            raise DataError(f"expected a class from 0 to {len(self.of_data) - 1}, found {found}")
        indices = self.of_data[boxes.class_ids]
        is_shared = indices >= 0
        return Boxes(boxes.xyxy[is_shared], indices[is_shared], boxes.is_crowd[is_shared])

    def found(self, detections: Detections, model: int) -> Detections:
        """The MAX_DETECTIONS best of each of these classes, of the model number `model`."""
        indices = self.of_models[model][detections.class_ids]
        order = np.argsort(indices, kind="stable")
        rank = np.arange(len(order)) - np.searchsorted(indices[order], indices[order])
        kept = np.sort(order[(indices[order] >= 0) & (rank < MAX_DETECTIONS)])
        return Detections(detections.boxes_xyxy[kept], detections.scores[kept], indices[kept])


@dataclass(frozen=True, eq=False)
class EvaluatedImage:
    """What is in an image, and what was found; classes are indices into `EvaluatedClasses.names`."""

    label: str
    size_hw: tuple[int, int]
    truth: Boxes
    found: Detections


def _nothing_shared(data_names: Sequence[str], model_names: Sequence[str]) -> str:
    """The message if data set and model have no class in common."""
    hint = did_you_mean(data_names[0], model_names) if data_names else ""
    return (
        f"The data set has the classes {_listed(data_names)}, the model {_listed(model_names)}: they share "
        f"none that the settings select.{hint} Classes are compared by name."
    )


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(name[:40] for name in names[:_MAX_SHOWN])
    return f"{shown}, ..." if len(names) > _MAX_SHOWN else shown or "(none)"


@dataclass(frozen=True, eq=False)
class Matches:
    """The detections in all images, a row each: class by class, highest score first."""

    class_names: tuple[str, ...]
    class_ids: NDArray[np.int64]
    """(d,) ascending."""
    scores: NDArray[np.float64]
    """(d,)."""
    images: NDArray[np.int64]
    """(d,) indices of images."""
    is_right: NDArray[np.bool_]
    """(10, d): it matches an object, at each of the 10 IoU thresholds from 0.5 to 0.95."""
    is_ignored: NDArray[np.bool_]
    """(10, d): it is in a crowd, and neither right nor wrong."""
    rows: NDArray[np.int64]
    """(d,) where it is among the detections of all images, one image after the other."""
    targets: NDArray[np.int64]
    """(d,) where the object that it matches at IoU 0.5 is among those of all images, if it is right."""
    objects: NDArray[np.int64]
    """(classes, images) numbers of objects, without crowds."""
    ap50: NDArray[np.float64]
    """(classes,) average precision at IoU 0.5; NaN for a class without objects."""
    ap50_95: NDArray[np.float64]
    """(classes,) average precision, mean of IoU 0.5 to 0.95; NaN for a class without objects."""

    def of_class(self, class_id: int) -> slice:
        """Its rows."""
        return slice(*np.searchsorted(self.class_ids, (class_id, class_id + 1)).tolist())


def match(images: Sequence[EvaluatedImage], class_names: Sequence[str]) -> Matches:
    """Match the detections in `images` with their ground truth, class by class."""
    found = found_annotations(images)
    evaluation = _evaluated(truth_dataset(images, class_names), found)
    results = [result for result in evaluation.evalImgs if result]  # None: neither objects nor detections
    rows = _joined(results, "dtIds", np.empty(0)).astype(np.int64) - 1
    class_ids = np.array([one["category_id"] - 1 for one in found], np.int64)[rows]
    image_ids = np.array([one["image_id"] - 1 for one in found], np.int64)[rows]
    scores = _joined(results, "dtScores", np.empty(0))
    matched = _joined(results, "dtMatches", np.empty((10, 0))).astype(np.int64)
    is_ignored = _joined(results, "dtIgnore", np.empty((10, 0))).astype(np.bool_)
    objects = [
        0 if result is None else np.count_nonzero(np.equal(result["gtIgnore"], 0))
        for result in evaluation.evalImgs  # sorted by class, then by image
    ]
    order = np.lexsort((-scores, class_ids))
    # (10 IoU thresholds, 101 recalls, classes): -1 for a class without objects.
    precision = evaluation.eval["precision"][:, :, :, 0, 0]
    precision = np.where(precision < 0, np.nan, precision)
    return Matches(
        tuple(class_names),
        class_ids[order],
        scores[order],
        image_ids[order],
        is_right=((matched > 0) & ~is_ignored)[:, order],
        is_ignored=is_ignored[:, order],
        rows=rows[order],
        targets=matched[0, order] - 1,
        objects=np.array(objects, np.int64).reshape(len(class_names), len(images)),
        ap50=precision[0].mean(axis=0),
        ap50_95=precision.mean(axis=(0, 1)),
    )


def truth_dataset(images: Sequence[EvaluatedImage], class_names: Sequence[str]) -> dict[str, Any]:
    """The ground truth in COCO's format; ids count from 1, boxes are x, y, width and height in pixels."""
    truths = [image.truth for image in images]
    return {
        "images": [
            {"id": number, "file_name": image.label, "height": image.size_hw[0], "width": image.size_hw[1]}
            for number, image in enumerate(images, start=1)
        ],
        "annotations": _annotations(
            [(truth.xyxy, truth.class_ids, truth.is_crowd.astype(np.int64)) for truth in truths], "iscrowd"
        ),
        "categories": [{"id": number, "name": name} for number, name in enumerate(class_names, start=1)],
    }


def found_annotations(images: Sequence[EvaluatedImage]) -> list[dict[str, Any]]:
    """The detections in COCO's format."""
    found = [image.found for image in images]
    return _annotations([(one.boxes_xyxy, one.class_ids, one.scores) for one in found], "score")


def _annotations(of_images: Sequence[tuple[NDArray[Any], ...]], name: str) -> list[dict[str, Any]]:
    """Annotations of the objects in each image: their boxes, class ids, and values of what is called `name`.

    Ids count from 1: in COCOeval the id 0 is none.
    """
    rows = (
        (image_id, *row)
        for image_id, columns in enumerate(of_images, start=1)
        for row in zip(*(column.tolist() for column in columns), strict=True)
    )
    return [
        {
            "id": number,
            "image_id": image_id,
            "category_id": class_id + 1,
            "bbox": [x1, y1, x2 - x1, y2 - y1],
            "area": (x2 - x1) * (y2 - y1),
            name: value,
        }
        for number, (image_id, (x1, y1, x2, y2), class_id, value) in enumerate(rows, start=1)
    ]


def _evaluated(truth: dict[str, Any], found: list[dict[str, Any]]) -> Any:
    """COCOeval of the data set `truth` with the detections `found`, accumulated."""
    from pycocotools.cocoeval import COCOeval

    with contextlib.redirect_stdout(io.StringIO()):
        evaluation = COCOeval(_indexed(truth), _indexed({**truth, "annotations": found}), "bbox")
        evaluation.params.areaRng, evaluation.params.areaRngLbl = [_ANY_AREA], ["all"]
        evaluation.params.maxDets = [MAX_DETECTIONS]
        evaluation.evaluate()
        evaluation.accumulate()
    return evaluation


def _indexed(dataset: dict[str, Any]) -> Any:
    from pycocotools.coco import COCO

    coco = COCO()
    coco.dataset = dataset
    coco.createIndex()
    return coco


def _joined(
    results: Sequence[dict[str, Any]], name: str, nothing: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The column `name` of COCOeval's results, one after the other."""
    return np.concatenate([nothing, *(np.asarray(result[name]) for result in results)], axis=-1)
