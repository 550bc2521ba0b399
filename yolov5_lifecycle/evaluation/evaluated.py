"""Images with their ground truth and what a model found in them, in the classes that both have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.evaluation.ground_truth import Boxes, DataError, LabelError
from yolov5_lifecycle.settings.suggestion import did_you_mean

MIN_CONFIDENCE = 0.001
"""Detections with a lower score are not evaluated, as in YOLOv5's own validation."""
_MAX_SHOWN = 10


@dataclass(frozen=True)
class EvaluatedClasses:
    """The classes that the data set and the models share, by name.

    `of_data` and `of_model` map their class ids to indices into `names`; others are left out.
    """

    names: tuple[str, ...]
    of_data: Mapping[int, int]
    of_models: tuple[Mapping[int, int], ...]
    class_count: int
    """How many class ids the data set has."""
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
        return cls(
            names,
            _ids(data_names, index),
            tuple(_ids(model_names, index) for model_names, _ in models),
            len(data_names),
            tuple(name for name in dict.fromkeys(data_names) if name not in index),
        )

    def truth(self, boxes: Boxes) -> Boxes:
        """The boxes of these classes, with indices into `names`; raises LabelError for unknown ids."""
        if len(boxes) and boxes.class_ids.max() >= self.class_count:
            found = int(boxes.class_ids.max())
            raise LabelError(f"expected a class from 0 to {self.class_count - 1}, found {found}")
        indices, is_shared = _mapped(boxes.class_ids, self.of_data)
        return Boxes(boxes.xyxy[is_shared], indices, boxes.is_crowd[is_shared])

    def found(self, detections: Detections, model: int) -> Found:
        """The detections of the model number `model` that are of these classes, highest score first."""
        indices, is_shared = _mapped(detections.class_ids, self.of_models[model])
        return Found(
            detections.boxes_xyxy[is_shared].astype(np.float64),
            detections.scores[is_shared].astype(np.float64),
            indices,
        )


@dataclass(frozen=True, eq=False)
class Found:
    """Detections of an image, one row each, highest score first."""

    xyxy: NDArray[np.float64]
    """(n, 4) corners in pixels."""
    scores: NDArray[np.float64]
    """(n,) in [0, 1]."""
    class_ids: NDArray[np.int64]
    """(n,) indices into `EvaluatedClasses.names`."""


@dataclass(frozen=True, eq=False)
class EvaluatedImage:
    """What is in an image, and what was found."""

    label: str
    size_hw: tuple[int, int]
    truth: Boxes
    found: Found


def _ids(names: Sequence[str], index: Mapping[str, int]) -> dict[int, int]:
    return {class_id: index[name] for class_id, name in enumerate(names) if name in index}


def _mapped(
    class_ids: NDArray[np.int64], mapping: Mapping[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The indices of the ids in `mapping`, and which of the ids those are."""
    indices = np.array([mapping.get(class_id, -1) for class_id in class_ids.tolist()], np.int64)
    return indices[indices >= 0], indices >= 0


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
