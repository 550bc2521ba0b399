"""Files named .onnx that are cut, foreign, changed, or ask for memory and time."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from support import hostile_costs
from support.onnx_exports import model_of, serialized, valid
from support.small_families import SMALL_FAMILIES

_WEIGHT = "model.0.conv.weight"


def field(number: int, content: bytes) -> bytes:
    """A field of a protocol buffer message that has a length."""
    return varint(number << 3 | 2) + varint(len(content)) + content


def varint(number: int) -> bytes:
    low, high = number & 127, number >> 7
    return bytes([low | 128]) + varint(high) if high else bytes([low])


def glued(graph: bytes) -> bytes:
    """A file with the fields `graph` of a graph, followed by the weights of a valid one."""
    return _PREFIX + field(7, graph + weights())


_PREFIX = b"\x08\x07" + field(8, b"\x10\x0c")
"""Version of the format and opset 12."""


@functools.cache
def weights() -> bytes:
    """The arrays of a valid file."""
    arrays = model_of(valid()).graph.initializer
    return b"".join(field(5, array.SerializeToString()) for array in arrays)


def graph_without_weights() -> bytes:
    """The graph of a valid file without arrays: what `glued` takes."""
    model = model_of(valid())
    del model.graph.initializer[:]
    fields: bytes = model.graph.SerializeToString()
    return fields


def changed(change: Callable[[Any], object], **options: Any) -> Callable[[], bytes]:
    """A valid file after `change` of its model; `options` are those of `exported`."""

    def make() -> bytes:
        model = model_of(valid(**options))
        change(model)
        return serialized(model)

    return make


def node(model: Any, operator: str, number: int = 0) -> Any:
    return [node for node in model.graph.node if node.op_type == operator][number]


def attribute(model: Any, operator: str, name: str) -> Any:
    return next(entry for entry in node(model, operator).attribute if entry.name == name)


def array(model: Any, name: str = _WEIGHT) -> Any:
    return next(array for array in model.graph.initializer if array.name == name)


def replace_array(model: Any, name: str, numbers: Any) -> None:
    array(model, name).CopyFrom(numpy_helper.from_array(numbers, name))


def constant(model: Any, value: float) -> Any:
    """A constant of this number."""
    constants = [node.attribute[0].t for node in model.graph.node if node.op_type == "Constant"]
    return next(found for found in constants if numpy_helper.to_array(found).tolist() == value)


def set_weight(value: float) -> Callable[[Any], None]:
    def change(model: Any) -> None:
        numbers = numpy_helper.to_array(array(model)).copy()
        numbers.flat[0] = value
        replace_array(model, _WEIGHT, numbers)

    return change


def set_constant(value: float, other: float) -> Callable[[Any], None]:
    def change(model: Any) -> None:
        found = constant(model, value)
        found.CopyFrom(numpy_helper.from_array(np.array(other, np.float32)))

    return change


def rename_weights(model: Any) -> None:
    """As optimizers do that know only the graph."""
    for number, found in enumerate(model.graph.initializer):
        for reader in model.graph.node:
            reader.input[:] = [f"w{number}" if name == found.name else name for name in reader.input]
        found.name = f"w{number}"
    for number, reader in enumerate(model.graph.node):
        reader.name = f"node{number}"


def set_metadata(**entries: str) -> Callable[[Any], None]:
    def change(model: Any) -> None:
        found = {entry.key: entry.value for entry in model.metadata_props}
        helper.set_model_props(model, found | entries)

    return change


def reverse_inputs(model: Any) -> None:
    joined = node(model, "Concat", -2)
    joined.input[:] = list(joined.input)[::-1]


def shift_features(model: Any) -> None:
    """A convolution inside a C3 reads other cells; every shape is the same."""
    wide = next(node for node in model.graph.node if "model.2.m.0.cv2.conv.weight" in node.input)
    next(entry for entry in wide.attribute if entry.name == "pads").ints[:] = [2, 2, 0, 0]


def other_epsilon(model: Any) -> None:
    next(entry for entry in node(model, "BatchNormalization").attribute if entry.name == "epsilon").f = 1e-5


def select_boxes(model: Any) -> None:
    output = model.graph.output[0].name
    model.graph.node.append(helper.make_node("NonMaxSuppression", [output, output], ["selected"]))
    model.graph.output[0].name = "selected"


def read_bytes_of_images(model: Any) -> None:
    model.graph.input[0].type.tensor_type.elem_type = TensorProto.UINT8


def squash_grid(model: Any) -> None:
    """Cells half as far apart."""
    for found in [entry.attribute[0].t for entry in model.graph.node if entry.op_type == "Constant"]:
        numbers = numpy_helper.to_array(found)
        if numbers.ndim == 5:
            found.CopyFrom(numpy_helper.from_array(numbers / 2))


def other_file(model: Any) -> None:
    found = array(model)
    found.ClearField("raw_data")
    found.data_location = TensorProto.EXTERNAL
    found.external_data.add(key="location", value="/etc/passwd")


def branch(model: Any) -> None:
    inner = helper.make_graph([], "inner", [], [])
    model.graph.node.append(helper.make_node("If", ["images"], ["x"], then_branch=inner, else_branch=inner))


def loop(model: Any) -> None:
    """The output of a node is what it reads."""
    first = model.graph.node[0]
    first.input[0] = first.output[0]


def many_nodes() -> bytes:
    return glued(field(1, b"") * 1_000_000)


def deep() -> bytes:
    """Nested messages, each in an attribute of a node of the one around it."""
    inner = b""
    for _ in range(2_000):
        inner = field(1, field(5, field(6, inner)))
    return glued(graph_without_weights() + inner)


def many_readers() -> bytes:
    """Sums of one value, each read by the next."""
    nodes = [helper.make_node("Add", [f"v{n}", f"v{n}"], [f"v{n + 1}"]) for n in range(15_000)]
    nodes[0].input[:] = ["images", "images"]
    return _foreign(nodes)


def _foreign(nodes: list[Any], arrays: tuple[Any, ...] = ()) -> bytes:
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, [1, 3, 64, 64])
    output = helper.make_tensor_value_info(nodes[-1].output[0], TensorProto.FLOAT, None)
    graph = helper.make_graph(nodes, "foreign", [images], [output], arrays)
    return serialized(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)]))


def classifier() -> bytes:
    weight = numpy_helper.from_array(np.ones((8, 3, 3, 3), np.float32), "conv1.weight")
    nodes = [
        helper.make_node("Conv", ["images", "conv1.weight"], ["a"]),
        helper.make_node("GlobalAveragePool", ["a"], ["b"]),
    ]
    return _foreign(nodes, (weight,))


def growing_grid() -> bytes:
    """Boxes for whose cells sums of rows and columns are computed, which would be squares of them."""
    model = model_of(valid())
    for name, shape in (("row", (1, 1, 60_000, 1, 1)), ("column", (1, 1, 1, 60_000, 1))):
        model.graph.initializer.append(numpy_helper.from_array(np.zeros(shape, np.float32), name))
    sums = [place for place, entry in enumerate(model.graph.node) if entry.op_type == "Split"]
    split = model.graph.node[sums[0]]
    place = split.output[0]
    for entry in model.graph.node:
        entry.input[:] = ["wider" if name == place else name for name in entry.input]
    model.graph.node.insert(sums[0] + 1, helper.make_node("Add", [place, "row"], ["wide"]))
    model.graph.node.insert(sums[0] + 2, helper.make_node("Add", ["wide", "column"], ["wider"]))
    return serialized(model)


def many_grids() -> bytes:
    """Thousands of sums of large arrays, none of which is an output."""
    model = model_of(valid())
    model.graph.initializer.append(numpy_helper.from_array(np.zeros((1, 1, 700, 700, 2), np.float32), "zero"))
    place = next(entry for entry in model.graph.node if entry.op_type == "Split").output[0]
    model.graph.node.extend(helper.make_node("Add", [place, "zero"], [f"sum{n}"]) for n in range(10_000))
    return serialized(model)


def dimensions(*sizes: int) -> Callable[[], bytes]:
    return changed(lambda model: array(model).ClearField("dims") or array(model).dims.extend(sizes))


FILES: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "it has no graph"),
    "text": (lambda: b"not an export" * 9, "damaged, cut short or no ONNX model"),
    "first half": (lambda: valid()[: len(valid()) // 2], "damaged, cut short or no ONNX model"),
    "endless integer": (lambda: b"\xff" * 64, "an integer without end"),
    "a field of 8 EiB": (lambda: b"\x3a" + b"\xff" * 8 + b"\x7f", "a field claims"),
    "two graphs": (lambda: valid() + field(7, b""), "two graphs"),
    "a million nodes": (many_nodes, "more than 500000 fields"),
    "30,000 nodes": (lambda: glued(field(1, b"") * 30_000), "has 30000 nodes"),
    "a million packed dimensions": (
        lambda: glued(field(5, field(1, b"\x01" * 1_000_000))),
        "more than 500000 fields",
    ),
    "2,000 messages deep": (deep, "branches or loops"),
    "branches": (changed(branch), "branches or loops"),
    "a node that reads itself": (changed(loop), "which nothing makes"),
    "a name of a megabyte": (
        changed(lambda model: setattr(model.graph.node[0], "name", "x" * (1 << 20))),
        "a text of 1048576 bytes",
    ),
    "15,000 sums": (many_readers, "its weights have no names"),
    "a grid of 3,600,000,000 cells": (growing_grid, "its boxes are not computed as YOLOv5"),
    "10,000 grids": (many_grids, "larger arrays than images have cells"),
    "an array of 16 Ti numbers": (dimensions(1 << 22, 1 << 22), "of shape [4194304, 4194304] has 3456 bytes"),
    "an array of negative size": (dimensions(-1), "has the shape [-1]"),
    "an array of 40 dimensions": (dimensions(*[1] * 40), "dimensions: no weights of YOLOv5"),
    "an array of another shape": (
        changed(lambda model: replace_array(model, _WEIGHT, np.zeros((9, 3, 6, 6), np.float32))),
        "the tensor model.0.conv.bias has the shape (8,), expected (9,)",
    ),
    "integer weights": (
        changed(lambda model: replace_array(model, _WEIGHT, np.zeros((8, 3, 6, 6), np.int32))),
        "hold int32: not supported",
    ),
    "weights in another file": (changed(other_file), "lie in another file, which is not opened"),
    "weight NaN": (changed(set_weight(math.nan)), "not finite"),
    "operations of others": (
        changed(lambda model: setattr(node(model, "Conv"), "domain", "com.evil")),
        "operations of 'com.evil'",
    ),
    "opset 3": (
        changed(lambda model: setattr(model.opset_import[0], "version", 3)),
        "has opset 3, 9 to 21 are read",
    ),
    "another network": (classifier, "its weights have no names such as model.0.conv.weight"),
    "weights without names": (changed(rename_weights), "its weights have no names"),
    "another activation": (
        changed(lambda model: setattr(node(model, "Sigmoid", 1), "op_type", "Tanh")),
        "made by an operation 'Mul', which is no layer of YOLOv5",
    ),
    "another window": (
        changed(lambda model: attribute(model, "MaxPool", "ceil_mode").__setattr__("i", 1)),
        "layer 4 has the weights",
    ),
    "a shifted convolution": (changed(shift_features), "is made by a conv of 'model.2.m.0.cv2.conv.weight'"),
    "another epsilon": (
        changed(other_epsilon, architecture=SMALL_FAMILIES["cross-stage"]),
        "is made by a normalisation of 'model.2.bn.weight'",
    ),
    "layers joined in another order": (changed(reverse_inputs), "its boxes are not computed as YOLOv5"),
    "another size of boxes": (changed(set_constant(2.0, 3.0)), "its boxes are not computed as YOLOv5"),
    "cells half as far apart": (changed(squash_grid), "its boxes are not computed as YOLOv5"),
    "boxes selected": (changed(select_boxes), "selects them itself"),
    "raw outputs": (lambda: valid(era="raw"), "raw outputs and holds no anchors"),
    "preprocessing": (changed(read_bytes_of_images), "reads images of the element type 2"),
    "another stride": (changed(set_metadata(stride="64")), "has the stride '64'"),
    "another number of names": (changed(set_metadata(names="['a']")), "expected names of 3 classes"),
    "names that are a program": (
        changed(set_metadata(names="[__import__('os').system('true')]")),
        "class names in the metadata are damaged",
    ),
    "names, 100,000 deep": (changed(set_metadata(names="[" * 100_000 + "]")), "damaged at '[["),
    "a million names": (changed(set_metadata(names=f"[{'1,' * 1_000_000}]")), "more than 10000 class names"),
    "an export by the package ultralytics": (
        changed(set_metadata(task="detect", imgsz="[640, 640]")),
        "belongs to the ultralytics package",
    ),
    "10,000 classes, 32 anchors": (
        lambda: valid(hostile_costs.MANY_PREDICTIONS),
        "layer 1 (Detect) would keep 15.7 GB",
    ),
}
