"""The nodes, arrays and metadata of an ONNX file, as data: nothing in it is run."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import NamedTuple, Union

from yolov5_lifecycle.checkpoints.protobuf_fields import (
    ProtobufReader,
    Value,
    damaged,
    integer,
    nested,
    text,
)
from yolov5_lifecycle.checkpoints.stored_array import StoredArray, stored_array
from yolov5_lifecycle.models.model import WeightsError, shown

MAX_NODES = 20_000
"""The export of YOLOv5x6 has about 1,000."""
MAX_ARRAYS = 20_000
MAX_METADATA_BYTES = 4 << 20
"""Of an entry such as the class names: 10,000 of them with 200 characters each, some escaped."""
_METADATA = ("names", "stride", "task", "imgsz")
_OPSETS = range(9, 22)
_PARTS = (1, 5, 11, 12, 15)
"""Fields of a graph: nodes, arrays, inputs, outputs, sparse arrays."""
_OWN_DOMAINS = ("", "ai.onnx")
_FLOATS = frozenset({1, 10, 11})

Attribute = Union[int, float, str, tuple[int, ...], StoredArray]  # noqa: UP007 - for 3.10


class Node(NamedTuple):
    """An operation; an absent optional input is ""."""

    operator: str
    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Attribute]

    def integers(self, name: str, default: tuple[int, ...] = ()) -> tuple[int, ...]:
        """The attribute `name`, a list of integers."""
        found = self.attributes.get(name, default)
        return found if isinstance(found, tuple) else (-1,)


class Graph:
    """Nodes in order of execution, and arrays by name. Created by `read_graph`.

    Names of values that a copy or a conversion between floating-point types makes stand for the original.
    """

    def __init__(self, metadata: dict[str, str]) -> None:
        self.metadata = metadata
        self.nodes: list[Node] = []
        self.arrays: dict[str, StoredArray] = {}
        self.pixels = ""
        self.outputs: list[str] = []
        self.producers: dict[str, Node] = {}
        self.readers: dict[str, list[Node]] = {}
        self._originals: dict[str, str] = {}

    def original(self, value: str) -> str:
        return self._originals.get(value, value)

    def add(self, node: Node) -> None:
        """Add a node whose inputs are known; raises WeightsError."""
        inputs = tuple(map(self.original, node.inputs))
        for value in inputs:
            if value and value not in self.producers and value not in self.arrays and value != self.pixels:
                raise damaged(f"the node {shown(node.name)} reads {shown(value)}, which nothing makes")
        node = node._replace(inputs=inputs)
        for value in node.outputs:
            if value in self.producers or value in self.arrays or value in self._originals:
                raise damaged(f"the value {shown(value)} is made twice")
        if _is_copy(node) and inputs[0]:
            self._originals[node.outputs[0]] = inputs[0]
            return
        if node.operator == "Constant":
            constant = node.attributes.get("value")
            if not isinstance(constant, StoredArray):
                raise damaged(f"the constant {shown(node.name)} holds no array")
            self.arrays[node.outputs[0]] = constant
            return
        self.nodes.append(node)
        self.producers.update(dict.fromkeys(filter(None, node.outputs), node))
        for value in set(inputs):
            self.readers.setdefault(value, []).append(node)


def _is_copy(node: Node) -> bool:
    is_cast = node.operator == "Cast" and node.attributes.get("to") in _FLOATS
    return (node.operator == "Identity" or is_cast) and len(node.inputs) == len(node.outputs) == 1


def read_graph(data: bytes) -> Graph:
    """The graph in the bytes of an ONNX file; arrays are not read yet. Raises WeightsError."""
    reader = ProtobufReader()
    metadata: dict[str, str] = {}
    opset, message = 0, None
    for number, value in reader.fields(memoryview(data)):
        if number == 7 and message is not None:
            raise damaged("two graphs")
        if number == 7:
            message = nested(value)
        elif number == 8:
            opset = _opset(reader, nested(value)) or opset
        elif number == 14:
            metadata.update(_entry(reader, nested(value)))
    if message is None:
        raise damaged("it has no graph")
    if opset not in _OPSETS:
        raise WeightsError(
            f"the export has opset {opset}, {_OPSETS.start} to {_OPSETS.stop - 1} are read: export it again"
        )
    return _graph(reader, message, metadata)


def _graph(reader: ProtobufReader, message: memoryview, metadata: dict[str, str]) -> Graph:
    graph = Graph(metadata)
    parts: dict[int, list[memoryview]] = {}
    for number, value in reader.fields(message):
        if number in _PARTS:
            parts.setdefault(number, []).append(nested(value))
    nodes, stored, inputs, outputs, sparse = (parts.get(number, []) for number in _PARTS)
    if len(nodes) > MAX_NODES or len(stored) > MAX_ARRAYS:
        raise WeightsError(
            f"the graph has {len(nodes)} nodes and {len(stored)} arrays, at most {MAX_NODES} and "
            f"{MAX_ARRAYS} are read"
        )
    if sparse:
        raise WeightsError("it has sparse arrays, which no export of YOLOv5 has: use the .pt")
    for array in (stored_array(reader, part) for part in stored):
        if array.name in graph.arrays:
            raise damaged(f"two arrays are named {shown(array.name)}")
        graph.arrays[array.name] = array
    graph.pixels = _pixels(reader, inputs, graph)
    for part in nodes:
        graph.add(_node(reader, part))
    graph.outputs = [graph.original(_first_text(reader, part)) for part in outputs]
    return graph


def _pixels(reader: ProtobufReader, inputs: list[memoryview], graph: Graph) -> str:
    """The name of the images; torch before 1.5 lists weights as inputs, too."""
    found = {_first_text(reader, part): part for part in inputs}
    images = [name for name in found if name not in graph.arrays]
    if len(images) != 1:
        raise WeightsError(f"expected a graph that reads one array of images, found {shown(images)}")
    kind = _element_type(reader, found[images[0]])
    if kind not in _FLOATS:
        raise WeightsError(
            f"the graph reads images of the element type {kind}, expected floating-point numbers: an export "
            "with its own preprocessing is not read; use the .pt"
        )
    return images[0]


def _element_type(reader: ProtobufReader, message: memoryview) -> int:
    """The type of the elements in a ValueInfoProto, in its type, a tensor's; 0 if there is none."""
    for number in (2, 1):
        below = dict(reader.fields(message)).get(number)
        if not isinstance(below, memoryview):
            return 0
        message = below
    return integer(dict(reader.fields(message)).get(1, 0))


def _node(reader: ProtobufReader, message: memoryview) -> Node:
    inputs, outputs, name, operator = [], [], "", ""
    attributes: dict[str, Attribute] = {}
    for number, value in reader.fields(message):
        if number == 1:
            inputs.append(text(value))
        elif number == 2:
            outputs.append(text(value))
        elif number == 3:
            name = text(value)
        elif number == 4:
            operator = text(value)
        elif number == 5:
            key, attribute = _attribute(reader, nested(value))
            attributes[key] = attribute
        elif number == 7 and (domain := text(value)) not in _OWN_DOMAINS:
            raise WeightsError(f"the graph has operations of {shown(domain)}, which no export of YOLOv5 has")
    return Node(operator, name or "".join(outputs[:1]), tuple(inputs), tuple(outputs), attributes)


def _attribute(reader: ProtobufReader, message: memoryview) -> tuple[str, Attribute]:
    name, lists = "", list[int]()
    found: Attribute | None = None
    for number, value in reader.fields(message):
        if number == 1:
            name = text(value)
        elif number == 2:
            found = _float(value)
        elif number == 3:
            found = integer(value)
        elif number == 4:
            found = text(value)
        elif number == 5:
            found = stored_array(reader, nested(value))
        elif number == 8:
            lists.extend(reader.integers(value))
        elif number in (6, 11):
            raise WeightsError(
                "the graph has branches or loops, which no export of YOLOv5 has: use the .pt, or export that "
                "again"
            )
    return name, tuple(lists) if found is None else found


def _float(value: Value) -> float:
    if isinstance(value, int) or len(value) != 4:
        raise damaged("a number of another kind")
    number: float = struct.unpack("<f", value)[0]
    return number


def _opset(reader: ProtobufReader, message: memoryview) -> int:
    """The version of ONNX's own operators; 0 for those of another domain."""
    found = dict(reader.fields(message))
    is_own = 1 not in found or text(found[1]) in _OWN_DOMAINS
    return integer(found.get(2, 0)) if is_own else 0


def _entry(reader: ProtobufReader, message: memoryview) -> dict[str, str]:
    """The entry of the metadata if it is one that is used."""
    found = dict(reader.fields(message))
    key = text(found.get(1, memoryview(b"")), limit_bytes=MAX_METADATA_BYTES)
    if key not in _METADATA:
        return {}
    return {key: text(found.get(2, memoryview(b"")), limit_bytes=MAX_METADATA_BYTES)}


def _first_text(reader: ProtobufReader, message: memoryview) -> str:
    """The name of an input or output."""
    return next(_names(reader, message), "")


def _names(reader: ProtobufReader, message: memoryview) -> Iterator[str]:
    for number, value in reader.fields(message):
        if number == 1:
            yield text(value)
