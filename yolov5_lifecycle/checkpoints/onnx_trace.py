"""The shapes of all values in an ONNX graph, and what computing them costs, before anything is computed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import onnx
from onnx import helper, numpy_helper, shape_inference
from onnx.reference import ReferenceEvaluator

from yolov5_lifecycle.models.cost import MAX_ELEMENTS_PER_PIXEL, Cost, check_proportions
from yolov5_lifecycle.models.model import WeightsError, first_line, shown

_FLOAT_BYTES = 4
_MAX_KNOWN = 256
"""Elements of the values that are computed, because shapes of others follow from them."""
_MAX_COMPUTED = 2_000
"""Operations; a dynamic export of 657 has 296 of them, each of which takes 0.2 ms."""
_COMPUTED = frozenset({
    "Add", "And", "Cast", "Ceil", "Concat", "Constant", "ConstantOfShape", "Div", "Equal", "Expand", "Floor",
    "Gather", "Greater", "Identity", "Less", "Max", "Min", "Mod", "Mul", "Neg", "Not", "Or", "Range",
    "Reshape", "Round", "Slice", "Split", "Sqrt", "Squeeze", "Sub", "Transpose", "Unsqueeze", "Where",
})  # fmt: skip
_POSITIVE = ("strides", "dilations", "kernel_shape", "group")

Shape = tuple[int, ...]
MAX_DIMENSIONS = 8
"""Of an array; exports have 6."""


class Trace:
    """The graph of `model` for images of the shape `planes`, (batch, channels, h, w).

    Raises WeightsError if the shape of a value cannot be told, or costs more than any model needs.
    """

    def __init__(self, model: Any, planes: Shape) -> None:
        self.shapes: dict[str, Shape] = {}
        self._model = model
        self._types: dict[str, Any] = {}
        self._left = _MAX_COMPUTED
        self._known: dict[str, Any] = {}
        """Small values: lengths, sizes and places, as arrays of the package onnx."""
        for array in model.graph.initializer:
            self._add(array.name, helper.make_tensor_type_proto(array.data_type, array.dims))
            if math.prod(array.dims) <= _MAX_KNOWN:
                self._known[array.name] = array
        self._weights = sum(map(math.prod, self.shapes.values()))
        self._most_elements = MAX_ELEMENTS_PER_PIXEL * planes[0] * planes[2] * planes[3] + self._weights
        images = images_of(model)
        self._add(images.name, helper.make_tensor_type_proto(images.type.tensor_type.elem_type, planes))
        self.cost = self._traced(planes)
        try:
            check_proportions(self.cost)
        except ValueError as error:
            raise WeightsError(str(error)) from None

    def _traced(self, planes: Shape) -> Cost:
        nodes = self._model.graph.node
        last_reader = {name: index for index, node in enumerate(nodes) for name in node.input}
        last_reader.update({output.name: len(nodes) for output in self._model.graph.output})
        alive, most, layer, multiply_adds = math.prod(planes), 0, "the images", 0
        for index, node in enumerate(nodes):
            self._follow(node)
            multiply_adds += self._multiply_adds(node)
            alive += sum(self._elements(name) for name in node.output)
            if alive > most:
                most, layer = alive, _named(node)
            alive -= sum(self._elements(name) for name in set(node.input) if last_reader[name] == index)
        if lacking := [each.name for each in self._model.graph.output if each.name not in self.shapes]:
            raise WeightsError(f"nothing makes the output {shown(lacking[0])}: export it again")
        return Cost(
            images=planes[0],
            size_hw=(planes[2], planes[3]),
            multiply_adds=multiply_adds,
            activation_bytes=_FLOAT_BYTES * most,
            layer=layer,
            weight_bytes=_FLOAT_BYTES * self._weights,
            outputs=(),
        )

    def _follow(self, node: Any) -> None:
        """Find the shapes of what `node` makes, and its values if they are small and known."""
        if lacking := [name for name in node.input if name and name not in self._types]:
            raise WeightsError(
                f"{_named(node)} reads {shown(lacking[0])}, which nothing makes: export it again"
            )
        for attribute in node.attribute:
            if attribute.name in _POSITIVE and min([attribute.i or 1, *attribute.ints]) < 1:
                raise WeightsError(f"{_named(node)} has {attribute.name} that are not positive")
        try:
            types = self._inferred(node)
        except Exception as error:  # noqa: BLE001 - of many kinds
            raise WeightsError(f"{_named(node)} does not fit its inputs: {first_line(error)}") from None
        for name in filter(None, node.output):
            if name in self._types or name not in types:
                raise WeightsError(f"{_named(node)} makes {shown(name)}, which has a value or none")
            self._add(name, types[name])
            shape = self.shapes[name]
            if min(shape, default=1) < 0 or math.prod(shape) > self._most_elements:
                raise WeightsError(
                    f"{_named(node)} would make an array of shape {shown(shape)}, at most "
                    f"{self._most_elements:,} elements are computed"
                )
        self._compute(node)

    def _inferred(self, node: Any) -> Any:
        opsets = list(self._model.opset_import)
        (version,) = (opset.version for opset in opsets if opset.domain in ("", "ai.onnx"))
        return shape_inference.infer_node_outputs(
            onnx.defs.get_schema(node.op_type, version, ""),
            node,
            {name: self._types[name] for name in node.input if name},
            {name: self._known[name] for name in node.input if name in self._known},
            opset_imports=opsets,
            ir_version=self._model.ir_version,
        )

    def _add(self, name: str, kind: Any) -> None:
        tensor = kind.tensor_type
        if not tensor.HasField("shape") or not all(each.HasField("dim_value") for each in tensor.shape.dim):
            raise WeightsError(
                f"the size of {shown(name)} cannot be told from the size of the images: export the model "
                "again, without a selection of boxes"
            )
        if len(tensor.shape.dim) > MAX_DIMENSIONS:
            raise WeightsError(f"{shown(name)} would have {len(tensor.shape.dim):,} dimensions")
        self._types[name] = kind
        self.shapes[name] = tuple(each.dim_value for each in tensor.shape.dim)

    def _elements(self, name: str) -> int:
        return math.prod(self.shapes[name]) if name else 0

    def _compute(self, node: Any) -> None:
        """Compute the values of small outputs, from small inputs or from a shape."""
        if node.op_type == "Shape":
            ends = {each.name: each.i for each in node.attribute}
            shape = self.shapes[node.input[0]][ends.get("start", 0) : ends.get("end")]
            self._known[node.output[0]] = numpy_helper.from_array(np.array(shape, np.int64))
        elif self._is_computed(node):
            self._left -= 1
            try:
                self._known.update(self._computed(node))
            except Exception as error:  # noqa: BLE001 - of many kinds
                raise WeightsError(f"{_named(node)} cannot be computed: {first_line(error)}") from None

    def _is_computed(self, node: Any) -> bool:
        is_small = all(self._elements(name) <= _MAX_KNOWN for name in node.output)
        is_known = all(name in self._known for name in node.input if name)
        return is_small and is_known and self._left > 0 and node.op_type in _COMPUTED

    def _computed(self, node: Any) -> dict[str, Any]:
        inputs, outputs = (list(dict.fromkeys(filter(None, names))) for names in (node.input, node.output))
        ends = [[onnx.ValueInfoProto(name=name) for name in names] for names in (inputs, outputs)]
        graph = helper.make_graph([node], "node", *ends)
        versions = {opset.domain: opset.version for opset in self._model.opset_import}
        values = {name: numpy_helper.to_array(self._known[name]) for name in inputs}
        with np.errstate(all="ignore"):
            found = ReferenceEvaluator(graph, opsets=versions).run(None, values)
        return {
            name: numpy_helper.from_array(np.asarray(value))
            for name, value in zip(outputs, found, strict=True)
        }

    def _multiply_adds(self, node: Any) -> int:
        shapes: Sequence[Shape] = [self.shapes[name] if name else () for name in node.input]
        made = sum(self._elements(name) for name in node.output)
        if node.op_type == "Conv":
            return made * math.prod(shapes[1][1:])
        if node.op_type == "ConvTranspose":
            return math.prod(shapes[0]) * math.prod(shapes[1][1:])
        if node.op_type in ("MatMul", "Gemm"):
            return made * max(shapes[0][-2:], default=1)
        windows = [each.ints for each in node.attribute if each.name == "kernel_shape"]
        return made * math.prod(math.prod(sides) for sides in windows) + sum(map(math.prod, shapes))


def images_of(model: Any) -> Any:
    """The input of the graph; raises WeightsError unless there is one."""
    arrays = {array.name for array in model.graph.initializer}  # torch before 1.5 lists them as inputs, too
    found = [each for each in model.graph.input if each.name not in arrays]
    if len(found) != 1:
        raise WeightsError(f"expected a graph that reads images only, found {len(found)} inputs")
    return found[0]


def _named(node: Any) -> str:
    """Such as "the operation Conv '/model.0/conv/Conv'"."""
    return f"the operation {node.op_type[:40]} {shown(node.name)}"
