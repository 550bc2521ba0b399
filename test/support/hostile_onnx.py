"""Files named .onnx that are cut, foreign, changed, or ask for memory and time."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from onnx import TensorProto, helper, load_from_string, numpy_helper

from support.onnx_exports import serialized, small_export

_WEIGHT = "logits.weight"
_PREFIX = b"\x08\x08"
"""Version of the format."""


def field(number: int, content: bytes) -> bytes:
    """A field of a protocol buffer message that has a length."""
    return varint(number << 3 | 2) + varint(len(content)) + content


def varint(number: int) -> bytes:
    low, high = number & 127, number >> 7
    return bytes([low | 128]) + varint(high) if high else bytes([low])


def glued(graph: bytes) -> bytes:
    """A file with the fields `graph` of a graph, followed by the weights and metadata of a valid one."""
    return _PREFIX + field(7, graph + _weights()) + _rest()


@functools.cache
def _weights() -> bytes:
    arrays = load_from_string(small_export()).graph.initializer
    return b"".join(field(5, array.SerializeToString()) for array in arrays)


@functools.cache
def _rest() -> bytes:
    model = load_from_string(small_export())
    model.ClearField("graph")
    model.ClearField("ir_version")
    return serialized(model)


def graph_without_weights() -> bytes:
    """The graph of a valid file without arrays: what `glued` takes."""
    model = load_from_string(small_export())
    del model.graph.initializer[:]
    fields: bytes = model.graph.SerializeToString()
    return fields


def unsqueezed() -> bytes:
    """A file of opset 11, whose operation has 100,000 numbers one behind the other: a single field."""
    axes = field(1, b"axes") + b"\xa0\x01\x07" + field(8, b"".join(map(varint, range(4, 100_004))))
    operation = field(1, b"images") + field(2, b"x") + field(4, b"Unsqueeze") + field(5, axes)
    graph = field(1, operation) + graph_without_weights() + _weights()
    return _PREFIX + field(7, graph) + field(8, b"\x10\x0b")


def changed(change: Callable[[Any], object], **options: Any) -> Callable[[], bytes]:
    """A valid file after `change` of its model; `options` are those of `small_export`."""

    def make() -> bytes:
        model = load_from_string(small_export(**options))
        change(model)
        return serialized(model)

    return make


def array(model: Any, name: str = _WEIGHT) -> Any:
    return next(array for array in model.graph.initializer if array.name == name)


def add(*nodes: Any, **arrays: Any) -> Callable[[Any], None]:
    """Operations after the others, of which nothing is an output."""

    def change(model: Any) -> None:
        model.graph.node.extend(nodes)
        model.graph.initializer.extend(
            numpy_helper.from_array(np.array(value), name) for name, value in arrays.items()
        )

    return change


def node(operator: str, *inputs: str, output: str = "x", **attributes: Any) -> Any:
    return helper.make_node(operator, list(inputs), [output], **attributes)


def other_file(model: Any) -> None:
    found = array(model)
    found.ClearField("raw_data")
    found.data_location = TensorProto.EXTERNAL
    found.external_data.add(key="location", value="/etc/passwd")


def other_file_of_a_constant(model: Any) -> None:
    constant = TensorProto(name="c", data_type=1, dims=[4], data_location=TensorProto.EXTERNAL)
    constant.external_data.add(key="location", value="../../etc/passwd")
    add(node("Constant", value=constant))(model)


def branch(model: Any) -> None:
    inner = helper.make_graph([], "inner", [], [])
    add(node("If", "images", then_branch=inner, else_branch=inner))(model)


def reads_itself(model: Any) -> None:
    first = model.graph.node[0]
    first.input[0] = first.output[0]


def read_bytes_of_images(model: Any) -> None:
    model.graph.input[0].type.tensor_type.elem_type = TensorProto.UINT8


def no_boxes(model: Any) -> None:
    """The output of a classifier."""
    model.graph.node.append(node("GlobalAveragePool", "cells", output="mean"))
    model.graph.output[0].name = "mean"


def classes_of_boxes(model: Any) -> None:
    """As a head with boxes of five numbers, whose task is not told."""
    array(model, "shape").CopyFrom(numpy_helper.from_array(np.array([0, 4, -1]), "shape"))


def deep() -> bytes:
    """Nested messages, each in an attribute of a node of the one around it."""
    inner = b""
    for _ in range(2_000):
        inner = field(1, field(5, field(6, inner)))
    return glued(graph_without_weights() + inner)


def every_place_with_every_other() -> bytes:
    """A product that grows with the square of the image, as attention does, but of too many places."""
    nodes = [
        node("AveragePool", "images", output="small", kernel_shape=[8, 8], strides=[8, 8]),
        node("Reshape", "small", "flat", output="pixels"),
        node("Transpose", "pixels", output="turned", perm=[0, 2, 1]),
        node("MatMul", "turned", "pixels", output="product"),
    ]
    return changed(add(*nodes, flat=[0, 3, -1]), size_hw=None)()


def doubling() -> Callable[[], bytes]:
    """Forty times twice as much of small numbers, from which nothing is read."""
    nodes = [node("Concat", f"v{n}", f"v{n}", output=f"v{n + 1}", axis=0) for n in range(40)]
    return changed(add(*nodes, v0=[1.0] * 8))


def many_convolutions() -> Callable[[], bytes]:
    """Each reads all pixels with the same few weights."""
    kernel = np.zeros((64, 64, 9, 9), np.float32)
    nodes = [node("Conv", f"c{n}", "k", output=f"c{n + 1}", pads=[4] * 4) for n in range(100)]
    nodes.insert(0, node("Expand", "zero", "wide", output="c0"))
    return changed(add(*nodes, k=kernel, zero=np.zeros((1, 64, 1, 1), np.float32), wide=[1, 64, 64, 96]))


def metadata(**entries: str) -> Callable[[], bytes]:
    return lambda: small_export(metadata={"names": "['a', 'b', 'c']", **entries})


def shape(*sizes: int) -> Callable[[], bytes]:
    """Of the images."""

    def change(model: Any) -> None:
        for each, size in zip(model.graph.input[0].type.tensor_type.shape.dim, sizes, strict=True):
            each.dim_value = size

    return changed(change)


FILES: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "it has no graph"),
    "text": (lambda: b"not an export" * 9, "damaged, cut short or no ONNX model"),
    "a field of 8 EiB": (lambda: b"\x3a" + b"\xff" * 8 + b"\x7f", "a field claims"),
    "a million inputs of a node": (
        lambda: glued(field(1, field(1, b"") * 1_000_000)),
        "more than 200,000 fields",
    ),
    "a name of eight megabytes": (
        changed(lambda model: setattr(model.graph.node[0], "name", "x" * (8 << 20))),
        "bytes besides the raw numbers",
    ),
    "30,000 nodes": (lambda: glued(field(1, b"") * 30_000), "has 30,000 operations"),
    "2,000 messages deep": (deep, "damaged, cut short or no ONNX model"),
    "a branch": (changed(branch), "has the operation 'If'"),
    "a graph within a convolution": (
        changed(lambda model: model.graph.node[0].attribute.add(name="body").g.node.add(op_type="Loop")),
        "has the operation 'Conv'",
    ),
    "graphs within a convolution": (
        changed(lambda model: model.graph.node[0].attribute.add(name="bodies").graphs.add(name="inner")),
        "has the operation 'Conv'",
    ),
    "a sparse tensor in a convolution": (
        changed(lambda model: model.graph.node[0].attribute.add(name="w").sparse_tensor.dims.append(1)),
        "has the operation 'Conv'",
    ),
    "a function": (
        changed(lambda model: model.functions.add(name="f", domain="own")),
        "it has functions",
    ),
    "a node that reads itself": (changed(reads_itself), "which nothing makes"),
    "an output that nothing makes": (
        changed(lambda model: model.graph.output.add(name="y")),
        "nothing makes the output 'y'",
    ),
    "an operation of another library": (
        changed(lambda model: setattr(model.graph.node[0], "domain", "com.evil")),
        "has operations of 'com.evil'",
    ),
    "boxes selected": (
        changed(add(node("NonMaxSuppression", "rows", "rows"))),
        "export it again with nms=False, or use the .pt",
    ),
    "opset 0": (
        changed(lambda model: setattr(model.opset_import[0], "version", 0)),
        "does not fit its inputs",
    ),
    "no opset": (changed(lambda model: model.ClearField("opset_import")), "no version of its operations"),
    "weights in another file": (changed(other_file), "lie in another file"),
    "a constant in another file": (changed(other_file_of_a_constant), "lie in another file"),
    "an array of 16 Ti numbers": (
        changed(lambda model: array(model).dims.__setitem__(slice(2), [1 << 22] * 2)),
        "of shape [4194304, 4194304, ",
    ),
    "an array of unknown numbers": (
        changed(lambda model: setattr(array(model), "data_type", 99)),
        "and kind 99 has",
    ),
    "an array of a million dimensions": (
        lambda: glued(graph_without_weights() + field(5, field(1, b"\1" * 1_000_000) + b"\x10\1")),
        "has 1,000,000 dimensions",
    ),
    "a hundred thousand dimensions more": (unsqueezed, "would have 100,004 dimensions"),
    "strides of 0": (
        changed(lambda model: model.graph.node[0].attribute[0].ints.__setitem__(0, 0)),
        "strides that are not positive",
    ),
    "a billion elements out of one": (
        changed(add(node("Expand", "one", "sizes"), one=[1.0], sizes=[1 << 30])),
        "would make an array of shape [1073741824]",
    ),
    "a range without end": (
        changed(add(node("Range", "zero", "end", "step"), zero=0.0, end=1e30, step=1e-30)),
        "cannot be computed: ValueError: Maximum allowed size exceeded",
    ),
    "forty times twice as much": (doubling(), "would make an array of shape"),
    "sizes that depend on the image": (
        changed(add(node("Reshape", "images", "places"), node("Cast", "images", output="places", to=7))),
        "which nothing makes",
    ),
    "a shape after 2,100 computations": (
        changed(
            add(
                *(node("Identity", f"v{n}", output=f"v{n + 1}") for n in range(2_100)),
                node("Reshape", "images", "v2100"),
                v0=[-1],
            )
        ),
        "cannot be told",
    ),
    "a hundred wide convolutions": (many_convolutions(), "the network would compute"),
    "numbers that do not fit": (
        changed(add(node("MatMul", "images", "matrix"), matrix=[[1.0, 2.0]])),
        "does not fit its inputs",
    ),
    "preprocessing": (changed(read_bytes_of_images), "of the element type 2"),
    "two inputs": (changed(lambda model: model.graph.input.add(name="scores")), "found 2 inputs"),
    "four channels": (shape(1, 4, 64, 96), "found [1, 4, 64, 96]"),
    "a batch of 65": (shape(65, 3, 64, 96), "found [65, 3, 64, 96]: export the model again"),
    "images without pixels": (shape(1, 3, 0, 96), "multiples of it, up to 4096"),
    "poses": (metadata(task="pose"), "was made for the task 'pose'"),
    "boxes selected in the head": (metadata(end2end="True"), "end2end=False"),
    "raw outputs": (
        changed(lambda model: setattr(model.graph.output[0], "name", "cells")),
        "exports with raw outputs are not read",
    ),
    "a classifier": (changed(no_boxes), "expected boxes of three dimensions"),
    "boxes of another meaning": (changed(classes_of_boxes), "they have another meaning"),
    "no names": (metadata(names="[]"), "they have another meaning"),
}
