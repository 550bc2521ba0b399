"""How an exported graph computes boxes, as formulas of the head's outputs; no number of an image is computed.

Every operation from the convolutions of the head to the outputs of the graph is followed for ranges of
columns of the predictions, each a x logit, a x logistic(logit) + b or a x logistic(logit)^2, with arrays a
and b for the cells of the grid.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.checkpoints.exported_formulas import (
    Columns,
    Known,
    Level,
    Sizes,
    cut,
    is_number,
    numbers_of,
)
from yolov5_lifecycle.checkpoints.onnx_graph import Graph, Node
from yolov5_lifecycle.checkpoints.stored_array import StoredArray
from yolov5_lifecycle.models.model import WeightsError

MAX_ELEMENTS = 1 << 24
"""In all arrays that are combined; for images of 4096x4096 pixels they have about 12,000,000."""
_MAX_SIZES = 16
"""In a shape."""
_UNKNOWN: NDArray[Any] = np.array(np.nan, np.float32)
"""What depends on the size of the images, such as the cells of a grid."""


def followed(graph: Graph, levels: Sequence[str]) -> dict[str, Known]:
    """What the values of `graph` are that depend on the outputs `levels` of the head's convolutions.

    Values that no export of YOLOv5 has are left out. Raises WeightsError for more than `MAX_ELEMENTS`.
    """
    known: dict[str, Known] = {value: Level(number) for number, value in enumerate(levels)}
    left = MAX_ELEMENTS
    for node in graph.nodes:
        if node.operator not in _FOLLOWED or any(output in known for output in node.outputs):
            continue
        if node.operator == "Shape" and node.outputs:
            known[node.outputs[0]] = Sizes()
            continue
        inputs = [known.get(value) or graph.arrays.get(value) for value in node.inputs]
        if node.operator == "Expand" and inputs and isinstance(inputs[0], StoredArray) and node.outputs:
            known[node.outputs[0]] = inputs[0]  # operations repeat it anyway
            continue
        if not inputs or any(found is None for found in inputs):
            continue
        has_level = any(isinstance(found, (Level, tuple)) for found in inputs)
        made: Sequence[Known] = _made(node, inputs) if has_level else [_size(node, inputs)]
        left -= sum(_elements(found) for found in made)
        if left < 0:
            raise WeightsError("its boxes are computed with larger arrays than images have cells")
        known.update(zip(node.outputs, made, strict=False))
    return known


def _elements(found: Known) -> int:
    columns = found.columns if isinstance(found, Level) else ()
    return sum(part.scale.size + part.offset.size for part in columns)


def _made(node: Node, inputs: list[Any]) -> Sequence[Known]:
    """The outputs of `node`; none if it is not one that computes boxes."""
    try:
        with np.errstate(all="ignore"):
            return _FOLLOWED[node.operator](node, [_read(found) for found in inputs])
    except (ArithmeticError, IndexError, TypeError, ValueError):
        return []


def _read(found: Any) -> Any:
    """The numbers of a stored array, in single precision unless they are integers."""
    if not isinstance(found, StoredArray):
        return found
    if found.elements > MAX_ELEMENTS:
        raise ValueError("an array of more cells than an image has")
    numbers = found.numbers()
    return numbers.astype(np.float32) if numbers.dtype.kind == "f" else numbers


def _level(found: object) -> Level:
    if not isinstance(found, Level):
        raise TypeError("expected the predictions of a level")
    return found


def _size(node: Node, inputs: list[Any]) -> Sizes:
    """What is computed from sizes and constants."""
    if any(isinstance(found, StoredArray) and found.elements > _MAX_SIZES for found in inputs):
        return Sizes()
    if node.operator in ("Unsqueeze", "Cast"):
        return Sizes(_vector(inputs[0]))
    if node.operator == "Gather":
        return Sizes((None,))
    if node.operator == "Concat":
        values: list[int | None] = []
        for found in inputs:
            vector = _vector(found)
            if vector is None:
                return Sizes()
            values.extend(vector)
        return Sizes(tuple(values))
    return Sizes()


def _vector(found: object) -> tuple[int | None, ...] | None:
    return found.values if isinstance(found, Sizes) else _integers(_read(found))


def _integers(found: object) -> tuple[int | None, ...] | None:
    """The numbers of a small array of integers."""
    if not isinstance(found, np.ndarray) or found.size > _MAX_SIZES or found.dtype.kind != "i":
        return None
    return tuple(found.ravel().tolist())


def _single(found: object) -> int:
    """The only number of an array of integers; raises ValueError if there are more."""
    (number,) = _integers(found) or ()
    return number or 0


def _reshaped(node: Node, inputs: list[Any]) -> Sequence[Known]:
    level, shape = inputs
    sizes = shape.values if isinstance(shape, Sizes) else _integers(shape)
    if isinstance(level, Level) and sizes is not None and len(sizes) == 5 and level.layout == "conv":
        anchors, outputs = sizes[1:3]
        if anchors and outputs and anchors > 0 and outputs > 0:
            return [replace(level, layout="split", anchors=anchors, columns=(Columns(0, outputs),))]
    if isinstance(level, Level) and level.layout == "cells" and (sizes is None or len(sizes) == 3):
        return [(level,)]
    return []


def _transposed(node: Node, inputs: list[Any]) -> Sequence[Known]:
    level = _level(inputs[0])
    if level.layout == "split" and node.integers("perm") == (0, 1, 3, 4, 2):
        return [replace(level, layout="cells")]
    return []


def _logistic(node: Node, inputs: list[Any]) -> Sequence[Known]:
    level = _level(inputs[0])
    if any(part.is_logistic or not part.is_plain for part in level.columns):
        return []
    return [replace(level, columns=tuple(replace(part, is_logistic=True) for part in level.columns))]


def _combined(change: Callable[[Columns, NDArray[Any]], Columns | None]) -> Callable[..., Sequence[Known]]:
    """What an operation of each cell with a number of its own gives; `change` is that of some columns."""

    def combine(node: Node, inputs: list[Any]) -> Sequence[Known]:
        level, operand = inputs
        if not isinstance(level, Level) and node.operator in ("Add", "Mul"):
            level, operand = operand, level
        numbers = _UNKNOWN if isinstance(operand, Sizes) else operand
        if not isinstance(level, Level) or level.layout != "cells" or not isinstance(numbers, np.ndarray):
            return []
        changed = [change(part, numbers_of(numbers, part, level.columns)) for part in level.columns]
        columns = tuple(part for part in changed if part is not None)
        return [replace(level, columns=columns)] if len(columns) == len(changed) else []

    return combine


def _bounded(*arrays: NDArray[Any]) -> None:
    if math.prod(np.broadcast_shapes(*(array.shape for array in arrays))) > MAX_ELEMENTS:
        raise ValueError("a grid of more cells than an image has")


def _added(part: Columns, numbers: NDArray[Any]) -> Columns:
    _bounded(part.offset, numbers)
    return replace(part, offset=part.offset + numbers)


def _subtracted(part: Columns, numbers: NDArray[Any]) -> Columns:
    return _added(part, -numbers)


def _multiplied(part: Columns, numbers: NDArray[Any]) -> Columns:
    _bounded(part.offset, part.scale, numbers)
    return replace(part, scale=part.scale * numbers, offset=part.offset * numbers)


def _raised(part: Columns, numbers: NDArray[Any]) -> Columns | None:
    is_square = is_number(numbers, 2) and part.power == 1 and part.is_logistic and is_number(part.offset, 0)
    return replace(part, power=2, scale=part.scale**2) if is_square else None


def _product(node: Node, inputs: list[Any]) -> Sequence[Known]:
    if node.inputs[0] == node.inputs[1]:
        return _combined(_raised)(node, [inputs[0], np.array(2)])
    return _combined(_multiplied)(node, inputs)


def _sliced(node: Node, inputs: list[Any]) -> Sequence[Known]:
    level = _level(inputs[0])
    first, end, axis, *strides = map(_single, inputs[1:])
    width = level.columns[-1].end - level.columns[0].first
    if level.layout != "cells" or axis not in (4, -1) or strides not in ([], [1]):
        return []
    return [cut(level, first, min(end if end >= 0 else end + width, width))] if first >= 0 else []


def _divided(node: Node, inputs: list[Any]) -> Sequence[Known]:
    level = _level(inputs[0])
    found = _whole(_integers(inputs[1])) if len(inputs) > 1 else node.integers("split")
    if level.layout != "cells" or node.attributes.get("axis") not in (4, -1) or not found:
        return []
    ends = list(itertools.accumulate(found))
    if len(ends) != len(node.outputs) or ends[-1] != level.columns[-1].end - level.columns[0].first:
        return []
    return [cut(level, end - width, end) for end, width in zip(ends, found, strict=True)]


def _whole(values: tuple[int | None, ...] | None) -> tuple[int, ...]:
    return tuple(value for value in values or () if value is not None)


def _joined(node: Node, inputs: list[Any]) -> Sequence[Known]:
    axis = node.attributes.get("axis")
    if all(isinstance(found, tuple) for found in inputs) and axis in (1, -2):
        return [tuple(level for rows in inputs for level in rows)]
    first = _level(inputs[0])
    if not all(replace(_level(found), columns=()) == replace(first, columns=()) for found in inputs):
        return []
    columns = tuple(part for found in inputs for part in found.columns)
    follows = all(before.end == after.first for before, after in itertools.pairwise(columns))
    if first.layout != "cells" or axis not in (4, -1) or not follows:
        return []
    return [replace(first, columns=columns)]


def _unfollowed(node: Node, inputs: list[Any]) -> Sequence[Known]:
    return []


_FOLLOWED: Mapping[str, Callable[[Node, list[Any]], Sequence[Known]]] = MappingProxyType(
    {
        "Reshape": _reshaped,
        "Transpose": _transposed,
        "Sigmoid": _logistic,
        "Add": _combined(_added),
        "Sub": _combined(_subtracted),
        "Mul": _product,
        "Pow": _combined(_raised),
        "Slice": _sliced,
        "Split": _divided,
        "Concat": _joined,
        **dict.fromkeys(
            (
                *("Shape", "Gather", "Unsqueeze", "Squeeze", "Cast", "Range", "Expand", "Tile", "Stack"),
                *("ConstantOfShape", "Equal", "Where", "Div", "Floor", "Neg"),
            ),
            _unfollowed,
        ),
    }
)
"""By operator; the last ones make a grid from the size of the images."""
