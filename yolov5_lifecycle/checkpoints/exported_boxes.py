"""Classes, anchors and strides of an exported network, from the formulas of its boxes."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.checkpoints.exported_formulas import Columns, Level
from yolov5_lifecycle.checkpoints.exported_head import followed
from yolov5_lifecycle.checkpoints.onnx_graph import Graph
from yolov5_lifecycle.checkpoints.yaml_architecture import MAX_ANCHORS, MAX_LEVELS, MAX_STRIDE
from yolov5_lifecycle.models.architecture import AnchorsPx
from yolov5_lifecycle.models.model import MAX_CLASSES, WeightsError, checked_integer, shown

_NOT_OURS = "its boxes are not computed as YOLOv5 computes them: use the .pt, or export that again"
_MAX_ERROR_CELLS = 0.01


class ExportedBoxes(NamedTuple):
    """What boxes are computed from; `coefficients` are those of masks."""

    classes: int
    coefficients: int
    anchors_px: AnchorsPx
    strides: tuple[int, ...]


def exported_boxes(graph: Graph, levels: list[str]) -> ExportedBoxes:
    """The boxes of `graph`, in which the convolutions of the head make `levels`. Raises WeightsError."""
    if not 1 <= len(levels) <= MAX_LEVELS:
        raise WeightsError(f"expected a head of 1 to {MAX_LEVELS} levels, found {len(levels)}")
    known = followed(graph, levels)
    made = [known.get(value) for value in graph.outputs]
    rows = next((found for found in made if isinstance(found, tuple)), None)
    if rows is None:
        raise WeightsError(_without_boxes(graph, made))
    if [level.number for level in rows] != list(range(len(levels))):
        raise WeightsError(_NOT_OURS)
    boxes = [_boxes(level) for level in rows]
    if len({found[1:3] for found in boxes}) != 1:
        raise WeightsError(_NOT_OURS)
    _, classes, coefficients, _ = boxes[0]
    return ExportedBoxes(
        checked_integer(classes, "the number of classes", 1, MAX_CLASSES),
        coefficients,
        tuple(found[3] for found in boxes),
        tuple(found[0] for found in boxes),
    )


def _without_boxes(graph: Graph, made: list[Any]) -> str:
    if made and all(isinstance(found, Level) for found in made):
        return (
            "it gives raw outputs and holds no anchors, so boxes cannot be computed, like exports by YOLOv5 "
            "before 6.0 and those with --train: use the .pt, or export that again without --train"
        )
    operators = sorted({node.operator for node in graph.nodes})
    told = " and selects them itself" if "NonMaxSuppression" in operators else ""
    return f"{_NOT_OURS}{told}"


def _boxes(level: Level) -> tuple[int, int, int, tuple[tuple[float, float], ...]]:
    """Stride, classes, coefficients of masks and anchors in pixels of a level."""
    columns = list(level.columns)
    if [(part.first, part.end) for part in columns[:2]] != [(0, 2), (2, 4)] or level.anchors > MAX_ANCHORS:
        raise WeightsError(_NOT_OURS)
    place, size, *others = columns
    scores = [part for part in others if part.is_logistic]
    masks = others[len(scores) :]
    if not scores or not all(part.is_plain for part in others) or any(part.is_logistic for part in masks):
        raise WeightsError(_NOT_OURS)
    stride = _stride(place)
    end = scores[-1].end
    return stride, end - 5, columns[-1].end - end, _anchors(size, level.anchors)


def _stride(place: Columns) -> int:
    """That of (2 logistic - 0.5 + cell) * stride."""
    stride = float(place.scale.item()) / 2 if place.scale.size == 1 else 0.0
    is_whole = 1 <= stride <= MAX_STRIDE and stride == int(stride)
    if not is_whole or (place.is_logistic, place.power) != (True, 1):
        raise WeightsError(_NOT_OURS)
    if not np.isnan(place.offset).all():
        _check_cells(place.offset / stride)
    return int(stride)


def _check_cells(offset: NDArray[Any]) -> None:
    """Expect for (1, anchors, ny, nx, 2) the column and the row of each cell, less a half."""
    if offset.ndim != 5 or offset.shape[-1] != 2:
        raise WeightsError(_NOT_OURS)
    ny, nx = offset.shape[2:4]
    rows, columns = np.meshgrid(np.arange(ny) - 0.5, np.arange(nx) - 0.5, indexing="ij")
    if not (abs(offset - np.stack((columns, rows), axis=-1)) <= _MAX_ERROR_CELLS).all():
        raise WeightsError(_NOT_OURS)


def _anchors(size: Columns, anchors: int) -> tuple[tuple[float, float], ...]:
    """Those of (2 logistic)^2 * anchor, which are the same for every cell."""
    if (
        (size.is_logistic, size.power) != (True, 2)
        or size.offset.any()
        or size.scale.ndim != 5
        or not size.scale.size
    ):
        raise WeightsError(_NOT_OURS)
    batch, count, _, _, pair = size.scale.shape
    if (batch, count, pair) != (1, anchors, 2):
        raise WeightsError(f"expected {anchors} anchors, found {shown(size.scale.shape)}: {_NOT_OURS}")
    first = size.scale[:, :, :1, :1]
    if not (size.scale == first).all():
        raise WeightsError(_NOT_OURS)
    return tuple((float(width), float(height)) for width, height in (first / 4).reshape(-1, 2).tolist())
