"""Exports to ONNX: checked, and told apart by their layout, before a runtime sees them."""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import onnx

from yolov5_lifecycle.checkpoints.onnx_trace import MAX_DIMENSIONS, Shape, Trace, images_of
from yolov5_lifecycle.models.cost import MAX_STRIDE, Cost
from yolov5_lifecycle.models.model import MAX_CLASSES, Export, WeightsError, check_class_names, shown

MAX_NODES = 5_000
"""The export of YOLOv5x6 has about 1,000."""
_MAX_BATCH = 64
_ANY_STRIDE = 64
"""What the largest models need; exports before v6.2 do not tell theirs."""
_SMALL_SIDE, _MAX_SIDE = 128, 4096
_FLOAT, _HALF = 1, 10
_BYTES = {_FLOAT: 4, 2: 1, 3: 1, 6: 4, 7: 8, 9: 1, _HALF: 2, 11: 8}
"""Of an element, by TensorProto.DataType."""
_MAX_UNPACKED = 65_536
"""Numbers of an array that are not raw; no weights are stored like that."""
OPERATIONS = frozenset({
    "Abs", "Add", "And", "ArgMax", "AveragePool", "BatchNormalization", "Cast", "Ceil", "Clip", "Concat",
    "Constant", "ConstantOfShape", "Conv", "ConvTranspose", "CumSum", "DepthToSpace", "Div", "Elu", "Equal",
    "Erf", "Exp", "Expand", "Flatten", "Floor", "Gather", "Gelu", "Gemm", "GlobalAveragePool",
    "GlobalMaxPool", "Greater", "GreaterOrEqual", "HardSigmoid", "HardSwish", "Identity",
    "InstanceNormalization", "LayerNormalization", "LeakyRelu", "Less", "LessOrEqual", "Log", "MatMul",
    "Max", "MaxPool", "Min", "Mish", "Mod", "Mul", "Neg", "Not", "Or", "PRelu", "Pad", "Pow", "Range",
    "Reciprocal", "ReduceL2", "ReduceMax", "ReduceMean", "ReduceSum", "Relu", "Reshape", "Resize", "Round",
    "ScatterND", "Shape", "Sigmoid", "Slice", "Softmax", "Softplus", "SpaceToDepth", "Split", "Sqrt",
    "Squeeze", "Sub", "Sum", "Tanh", "Tile", "Transpose", "Unsqueeze", "Upsample", "Where",
})  # fmt: skip
"""Those of exports: their cost follows from shapes. Without loops, branches, and selections of boxes."""

_ESCAPE = r"\\(?:[\\'\"nrt]|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})"
_NAME = rf"'(?:[^'\\\n]|{_ESCAPE})*'|\"(?:[^\"\\\n]|{_ESCAPE})*\"|-?\d{{1,18}}|True|False|None"
_NAMES = re.compile(rf"[\[{{]\s*(?:(?:\d{{1,6}}\s*:\s*)?(?:{_NAME})\s*(?:,\s*|(?=[\]}}])))*[\]}}]")
"""The text of a flat list, or of a dict by number: what can be parsed at a known cost."""
_MAX_NAMES = 1 << 18

MAX_FIELDS = 200_000
"""Fields of all messages on the way to the numbers; the export of YOLOv5x6 has about 40,000."""
MAX_STRUCTURE_BYTES = 4 << 20
"""All of a file but its raw numbers; the export of YOLOv5x6 has 0.3 MB."""
_Places = Mapping[int, "_Places | None"]
_NUMBERS: _Places = {7: {5: {9: None}, 1: {5: {5: {9: None}}}}}
"""Field numbers on the way to raw numbers: graph, array or graph, node, attribute, array; None is the end."""
_VARINT, _WITH_LENGTH = 0, 2
_FIXED_BYTES = {1: 8, 5: 4}
_MAX_VARINT_BYTES = 10


def read_onnx(data: bytes) -> Export:
    """The export in the bytes of an ONNX file, which is not run. Raises WeightsError."""
    _check_structure(data)
    try:
        model: Any = onnx.load_from_string(data)
    except Exception:  # noqa: BLE001 - DecodeError of protobuf, which only onnx depends on
        raise _damaged("its messages") from None
    _check_graph(model)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    _check_task(metadata)
    is_half, batch, channels, size_hw = _images(images_of(model))
    stride = _stride(metadata, size_hw)
    side = math.ceil(_SMALL_SIDE / stride) * stride
    trace = Trace(model, (batch or 1, channels, *(size_hw or (side, side))))
    shapes = [trace.shapes[output.name] for output in model.graph.output]
    boxes, prototypes = _placed(shapes, batch or 1)
    masks = 0 if prototypes is None else shapes[prototypes][1]
    names = _told_names(metadata)
    has_objectness, classes = _layout(shapes[boxes], masks, names)
    return Export(
        graph=data,
        class_names=check_class_names(names or {}, classes, remedy="export the model again, with its names"),
        channels=channels,
        stride=stride,
        is_half=is_half,
        has_objectness=has_objectness,
        mask_coefficients=masks,
        boxes=boxes,
        prototypes=prototypes,
        size_hw=size_hw,
        batch=batch,
    )


def export_cost(export: Export, size_hw: tuple[int, int]) -> Cost:
    """The cost of a run for images of `size_hw`; raises WeightsError if it is out of proportion."""
    model = onnx.load_from_string(export.graph)
    return Trace(model, (export.batch or 1, export.channels, *size_hw)).cost


def _check_graph(model: Any) -> None:
    """Raise WeightsError for what could read files, or whose cost cannot be told."""
    graph = model.graph
    if not graph.node:
        raise _damaged("it has no graph")
    if len(graph.node) > MAX_NODES:
        raise WeightsError(f"the graph has {len(graph.node):,} operations, at most {MAX_NODES:,} are read")
    if sum(opset.domain in ("", "ai.onnx") for opset in model.opset_import) != 1:
        raise _damaged("no version of its operations, or two")
    if model.functions or model.training_info or graph.sparse_initializer:
        raise WeightsError("it has functions, training or sparse arrays, which no export of YOLO has")
    for array in graph.initializer:
        _check_array(array)
    for node in graph.node:
        _check_node(node)


def _check_node(node: Any) -> None:
    if node.domain not in ("", "ai.onnx"):
        raise WeightsError(f"the graph has operations of {shown(node.domain)}, which are not run")
    inner = [each for each in node.attribute if each.HasField("g") or each.graphs]
    if (
        node.op_type not in OPERATIONS
        or inner
        or any(each.HasField("sparse_tensor") for each in node.attribute)
    ):
        raise WeightsError(
            f"the graph has the operation {shown(node.op_type)}: an export that selects boxes itself, has "
            "branches or loops or does anything else but compute boxes is not read; export it again with "
            "nms=False, or use the .pt"
        )
    for attribute in node.attribute:
        for array in (*attribute.tensors, *([attribute.t] if attribute.HasField("t") else [])):
            _check_array(array)


def _check_array(array: Any) -> None:
    if array.external_data or array.data_location != onnx.TensorProto.DEFAULT:
        raise WeightsError(
            f"the numbers of {shown(array.name)} lie in another file, which is not opened: export the model "
            "again, as one file"
        )
    if len(array.dims) > MAX_DIMENSIONS:
        raise WeightsError(
            f"the array {shown(array.name)} has {len(array.dims):,} dimensions, expected at most "
            f"{MAX_DIMENSIONS}"
        )
    elements, element_bytes = math.prod(array.dims), _BYTES.get(array.data_type, 0)
    if array.HasField("raw_data"):
        is_whole = elements * element_bytes == len(array.raw_data)
    else:
        is_whole = elements <= _MAX_UNPACKED
    if not is_whole or not element_bytes or min(array.dims, default=1) < 0:
        raise WeightsError(
            f"the array {shown(array.name)} of shape {shown(list(array.dims))} and kind {array.data_type} "
            f"has {len(array.raw_data)} bytes: copy or export the file again"
        )


def _images(images: Any) -> tuple[bool, int | None, int, tuple[int, int] | None]:
    """Whether `images`, what the graph reads, are of float16; their number, channels, height and width.

    None stands for any. Raises WeightsError.
    """
    tensor = images.type.tensor_type
    planes: list[Any] = [each.dim_value if each.HasField("dim_value") else None for each in tensor.shape.dim]
    if tensor.elem_type not in (_FLOAT, _HALF) or len(planes) != 4 or planes[1] not in (1, 3):
        raise WeightsError(
            f"expected images [batch, 3 or 1, height, width] of float32 or float16, found {shown(planes)} of "
            f"the element type {tensor.elem_type}: an export with its own preprocessing is not read"
        )
    batch, channels, *sides = planes
    is_any_size = sides == [None, None]
    if (None in sides and not is_any_size) or not 0 < (1 if batch is None else batch) <= _MAX_BATCH:
        raise WeightsError(
            f"expected height and width both fixed or both free, and batches of 1 to {_MAX_BATCH}, found "
            f"{shown(planes)}: export the model again"
        )
    return tensor.elem_type == _HALF, batch, channels, None if is_any_size else (sides[0], sides[1])


def _stride(metadata: Mapping[str, str], size_hw: tuple[int, int] | None) -> int:
    """The largest stride; raises WeightsError unless a fixed size is a multiple of it."""
    told = re.fullmatch(r"([1-9]\d{0,3})(?:\.0)?", metadata.get("stride", str(_ANY_STRIDE)), re.ASCII)
    stride = int(told[1]) if told else 0
    if "stride" not in metadata and size_hw:
        stride = math.gcd(*size_hw, _ANY_STRIDE)
    if not 0 < stride <= MAX_STRIDE or any(
        side % stride or not 0 < side <= _MAX_SIDE for side in size_hw or ()
    ):
        raise WeightsError(
            f"expected a stride up to {MAX_STRIDE} in the metadata, and height and width of images that are "
            f"multiples of it, up to {_MAX_SIDE}, found {shown(metadata.get('stride'))} and {size_hw}: "
            "export the model again"
        )
    return stride


def _check_task(metadata: Mapping[str, str]) -> None:
    task = metadata.get("task", "detect")
    if task not in ("detect", "segment"):
        raise WeightsError(f"it was made for the task {shown(task)}, expected detect or segment")
    if metadata.get("end2end", "False") != "False":
        raise WeightsError("it selects boxes itself (end2end): export it again with end2end=False, nms=False")


def _placed(shapes: list[Shape], batch: int) -> tuple[int, int | None]:
    """Which outputs are the boxes and the prototypes; raw outputs beside them, as before v6.2, are unused."""
    boxes = [place for place, shape in enumerate(shapes) if len(shape) == 3]
    prototypes = [place for place, shape in enumerate(shapes) if len(shape) == 4]
    if len(boxes) != 1 or len(prototypes) > 1 or any(shape[:1] != (batch,) for shape in shapes):
        raise WeightsError(
            "expected boxes of three dimensions and, of a model that segments, prototypes of four, found "
            f"outputs {', '.join(map(shown, shapes[:8]))}: exports with raw outputs are not read"
        )
    return boxes[0], prototypes[0] if prototypes else None


def _layout(shape: Shape, masks: int, names: Mapping[int, object] | None) -> tuple[bool, int]:
    """Whether there is objectness, and the number of classes; raises WeightsError."""
    _, rows, columns = shape
    with_objectness, without = columns - 5 - masks, rows - 4 - masks
    classes = (
        (with_objectness if rows > columns else without) if names is None else max(names, default=-1) + 1
    )
    if not 0 < classes <= MAX_CLASSES or classes not in (with_objectness, without):
        raise WeightsError(
            f"expected boxes [batch, N, {5 + masks} + classes] or [batch, {4 + masks} + classes, N] with "
            f"{'1' if names is None else classes} to {MAX_CLASSES} classes, found {shown(shape)}: they have "
            "another meaning; export a model that detects or segments"
        )
    return classes == with_objectness, classes


def _told_names(metadata: Mapping[str, str]) -> dict[int, object] | None:
    """The class names by index, read as a literal; None before v6.2, which told none. Raises WeightsError."""
    entry = metadata.get("names", "").strip()
    if "names" not in metadata:
        return None
    names: object = None
    if len(entry) <= _MAX_NAMES and _NAMES.fullmatch(entry):
        with suppress(SyntaxError, ValueError):
            names = ast.literal_eval(entry)
    if not isinstance(names, (list, dict)):
        raise WeightsError(
            f"expected a list or dict of class names in the metadata, of at most {_MAX_NAMES:,} characters, "
            f"found {shown(entry)}: export the model again"
        )
    return dict(enumerate(names)) if isinstance(names, list) else names


def _check_structure(data: bytes) -> None:
    """Raise WeightsError if the file is no protocol buffer message or has more structure than an export.

    Before the package onnx makes an object of each part: a hundred bytes of every two of a hostile file.
    """
    structure_bytes, fields = len(data), 0
    messages = [(memoryview(data), _NUMBERS)]
    while messages:
        message, places = messages.pop()
        place = 0
        while place < len(message):
            fields += 1
            if fields > MAX_FIELDS:
                raise WeightsError(f"the file has more than {MAX_FIELDS:,} fields: no export of YOLO has")
            key, begin, place = _field(message, place)
            if key & 7 == _WITH_LENGTH and key >> 3 in places:
                below = places[key >> 3]
                if below is None:
                    structure_bytes -= place - begin
                else:
                    messages.append((message[begin:place], below))
    if structure_bytes > MAX_STRUCTURE_BYTES:
        raise WeightsError(
            f"the file has {structure_bytes:,} bytes besides the raw numbers of its arrays, at most "
            f"{MAX_STRUCTURE_BYTES:,} are read: export the model again"
        )


def _field(message: memoryview, place: int) -> tuple[int, int, int]:
    """Number and kind of the field at `place` as one integer, and the begin and end of its value."""
    key, begin = _varint(message, place)
    kind, length = key & 7, 0
    if kind == _VARINT:
        _, end = _varint(message, begin)
        return key, begin, end
    if kind == _WITH_LENGTH:
        length, begin = _varint(message, begin)
    elif kind in _FIXED_BYTES:
        length = _FIXED_BYTES[kind]
    else:
        raise _damaged(f"a field of kind {kind}")
    if length > len(message) - begin:
        raise _damaged(f"a field claims {length} bytes, {len(message) - begin} are left")
    return key, begin, begin + length


def _varint(data: memoryview, place: int) -> tuple[int, int]:
    """An integer of up to 64 bits, and the place after it."""
    number = 0
    for count, byte in enumerate(data[place : place + _MAX_VARINT_BYTES]):
        number |= (byte & 127) << (7 * count)
        if byte < 128:
            return number, place + count + 1
    raise _damaged("an integer without end")


def _damaged(found: str) -> WeightsError:
    """The refusal of a file that is not a message of the expected kind."""
    return WeightsError(f"the file is damaged, cut short or no ONNX model ({found}): copy or export it again")
