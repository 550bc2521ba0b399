"""Images with their ground truth and what a model found in them, in the classes that both have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.evaluation.ground_truth import Boxes, DataError, LabelError
from yolov5_lifecycle.settings.suggestion import did_you_mean

MIN_CONFIDENCE = 0.001
"""Detections with a lower score are not evaluated, as in YOLOv5's own validation."""
MAX_DETECTIONS = 100
"""Only this many of the best detections per image and class count, as in COCO's evaluation."""
_MAX_SHOWN = 10


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
        """The boxes of these classes, with indices into `names`; raises LabelError for unknown ids."""
        if boxes.class_ids.max(initial=0) >= len(self.of_data):
            found = int(boxes.class_ids.max())
            raise LabelError(f"expected a class from 0 to {len(self.of_data) - 1}, found {found}")
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
