"""Files named .safetensors that are cut, overlap, or ask for memory and time."""

from __future__ import annotations

import functools
import json
import math
import struct
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save

from support.checkpoint_builder import SMALL
from support.random_model import random_model
from yolov5_lifecycle.checkpoints.safetensors_file import MAX_HEADER_BYTES, write_safetensors
from yolov5_lifecycle.models.model import Model


@functools.cache
def valid() -> bytes:
    return written(random_model(0, SMALL))


def written(model: Model) -> bytes:
    """The bytes of the file that `model` becomes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "valid.safetensors"
        write_safetensors(model, path)
        return path.read_bytes()


def cut(data: bytes) -> tuple[bytes, bytes]:
    """The header's text and the tensors of a file."""
    end = 8 + int.from_bytes(data[:8], "little")
    return data[8:end], data[end:]


def glued(text: bytes, tensors: bytes) -> bytes:
    """The file of which `cut` makes these."""
    return struct.pack("<Q", len(text)) + text + tensors


def parted(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Header and tensors of a file."""
    text, tensors = cut(data)
    return json.loads(text), tensors


def joined(header: object, tensors: bytes) -> bytes:
    return glued(json.dumps(header).encode(), tensors)


def header(change: Callable[[dict[str, Any]], object]) -> Callable[[], bytes]:
    """A valid file after `change` of its header."""

    def make() -> bytes:
        entries, tensors = parted(valid())
        change(entries)
        return joined(entries, tensors)

    return make


def metadata(**changes: object) -> Callable[[], bytes]:
    return header(lambda entries: entries["__metadata__"].update(changes))


def architecture(**changes: object) -> Callable[[], bytes]:
    """A valid file whose architecture says something else."""
    return _described(lambda described: described.update(changes))


def layer(index: int, *row: object) -> Callable[[], bytes]:
    """A valid file whose architecture has another row [from, number, kind, arguments] as layer `index`."""
    return _described(lambda described: described["layers"].__setitem__(index, row))


def _with_long_strides(described: dict[str, Any]) -> None:
    """360 strides of 8 leave few cells: with one more at an edge, no later stride is a simple number."""
    smaller = [[-1, 100, "Conv", [64, 3, 8]]] * 3 + [[-1, 1, "MaxPool2d", [8, 8, 4]]] * 60
    larger = [[-1, 1, "ConvTranspose2d", [64, 8, 8]]] * 90
    *layers, head = described["layers"]
    described.update(depth_multiple=1.0, layers=[*layers, *smaller, *larger, head])


def _described(change: Callable[[dict[str, Any]], object]) -> Callable[[], bytes]:
    def changed(entries: dict[str, Any]) -> None:
        described = json.loads(entries["__metadata__"]["architecture"])
        change(described)
        entries["__metadata__"]["architecture"] = json.dumps(described)

    return header(changed)


CONVOLUTION, VARIANCES, ANCHORS = "model.0.conv.weight", "model.0.bn.running_var", "model.8.anchors"


def number(key: str, value: float) -> Callable[[], bytes]:
    """A valid file with another number at the beginning of the tensor `key`."""

    def make() -> bytes:
        entries, tensors = parted(valid())
        start = entries[key]["data_offsets"][0]
        packed = struct.pack({"F16": "<e", "F32": "<f"}[entries[key]["dtype"]], value)
        return joined(entries, tensors[:start] + packed + tensors[start + len(packed) :])

    return make


def overlapping(entries: dict[str, Any]) -> None:
    entries["model.0.bn.bias"]["data_offsets"] = entries["model.0.bn.weight"]["data_offsets"]


def another_tensor(dtype: torch.dtype, key: str = "\x1b[2J", removed: str = "") -> Callable[[], bytes]:
    """A valid file with one more tensor, or of another kind of numbers; one may be missing."""

    def make() -> bytes:
        tensors = load(valid())
        tensors.pop(removed, None)
        tensors[key] = tensors.get(key, torch.ones(1)).to(dtype)
        return save(tensors, metadata=parted(valid())[0]["__metadata__"])

    return make


def escaped_objects() -> bytes:
    """The text of the header does not show how many there are."""
    text, tensors = cut(metadata(architecture="[@0]")())
    return glued(text.replace(b"@", rb"\u007b\"\":0}\u002c" * 800_000), tensors)


_DEEP = "[" * 100_000
FILES: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "a few bytes": (lambda: bytes(7), "found 7 bytes"),
    "header of 16 EiB": (lambda: b"\xff" * 8 + b"{}", "its header does not fit"),
    "header larger than any": (lambda: glued(bytes(MAX_HEADER_BYTES + 1), b""), "its header does not fit"),
    "header that is a list": (lambda: glued(b"[[]]", b""), "its header is [a list]"),
    "header, 100,000 deep": (lambda: glued(_DEEP.encode(), b""), "its header is not JSON"),
    "header of two million objects": (
        lambda: glued(b'{"x":[' + b'{"":0},' * 2_000_000 + b"0]}", b""),
        "not JSON of at most 500000 values",
    ),
    "first half": (lambda: valid()[: len(valid()) // 2], "cut short"),
    "foreign file": (lambda: save({"a": torch.ones(3)}, {"format": "pt"}), "not written by this package"),
    "metadata that are a list": (
        header(lambda entries: entries.update(__metadata__=[1])),
        "not written by this package",
    ),
    "overlapping tensors": (header(overlapping), "damaged, or cut short"),
    "tensor of no layer": (another_tensor(torch.float32), "'\\x1b[2J' belongs to no layer"),
    "tensor that is missing": (another_tensor(torch.float32, removed=CONVOLUTION), "conv.weight is missing"),
    "tensor of 16 Ti numbers": (
        header(lambda entries: entries[CONVOLUTION].update(shape=[1 << 22, 1 << 22])),
        "damaged, or cut short",
    ),
    "tensor of unknown numbers": (
        another_tensor(torch.float8_e4m3fn, key=CONVOLUTION),
        "holds torch.float8_e4m3fn",
    ),
    "NaN": (number(CONVOLUTION, math.nan), "not finite"),
    "negative variance": (number(VARIANCES, -1), "negative variances"),
    "anchor without width": (number(ANCHORS, 0), "positive width and height"),
    "another anchor": (number(ANCHORS, 9), "are not those of the architecture"),
    "architecture that is no JSON": (metadata(architecture="{"), "entry architecture is missing or damaged"),
    "architecture of 800,000 objects, escaped": (escaped_objects, "has more than 500000 values"),
    "architecture that says nothing": (metadata(architecture="{}"), "architecture is damaged"),
    "architecture that is a list": (metadata(architecture="[]"), "architecture is damaged"),
    "a number of 10,000 digits": (metadata(architecture="9" * 10_000), "entry architecture is missing"),
    "names that are lists": (
        metadata(class_names='["a", [], "c"]'),
        "found a list: convert the original .pt again",
    ),
    "one class more": (architecture(classes=4), "names of 4 classes, found 3 names"),
    "other strides": (architecture(strides=[8, 16]), "the strides are [8, 16], but its layers"),
    "strides of more digits than Python writes": (_described(_with_long_strides), "have strides above 1024"),
    "100,000 strides": (architecture(strides=[8] * 100_000), "equally many anchors"),
    "no anchors": (architecture(anchors_px=[]), "equally many anchors"),
    "anchors of empty levels": (architecture(anchors_px=[[], []]), "anchors of a level: expected"),
    "anchors without heights": (architecture(anchors_px=[[[1]], [[1]]]), "architecture is damaged"),
    "anchors beyond all numbers": (architecture(anchors_px=[[[10**400, 1]]] * 2), "architecture is damaged"),
    "width that is a text": (architecture(width_multiple="1"), "width_multiple from 0.01 to 10"),
    "201 layers": (
        architecture(layers=[[[-1], 1, "Conv", [8]]] * 201),
        "expected 1 to 200 layers, found 201",
    ),
    "layers that are a dict": (architecture(layers={"a": 1}), "architecture is damaged"),
    "images of two channels": (architecture(image_channels=2), "reads images of 2 channels"),
    "no channel multiple": (architecture(channel_multiple=0), "the channel_multiple"),
    "activation": (architecture(activation="eval"), "expected an activation"),
    "activation with a steep slope": (architecture(activation="LeakyReLU(9)"), "expected an activation"),
    "fused as a number": (architecture(is_fused=1), "true or false as is_fused"),
    "fused": (architecture(is_fused=True), "model.0.conv.bias is missing"),
    "activation of what has none": (
        architecture(other_activations=[["model.0.bn", "ReLU"]]),
        "there is no activation at model.0.bn",
    ),
    "activations of no layers": (
        architecture(other_activations=[["ReLU"]]),
        "expected pairs of paths and activations",
    ),
    "kernel that is a text": (layer(0, [-1], 1, "Conv", [64, "6", 2]), "the kernel of layer 0"),
    "another kind": (layer(0, [-1], 1, "Focus", [64, 3]), "model.0.conv.conv.weight is missing"),
    "even kernel at stride 1": (layer(0, [-1], 1, "Conv", [64, 6]), "not supported"),
    "even window": (layer(4, [-1], 1, "SPPF", [64, 4]), "has the arguments [64, 4]"),
    "repeats that do not fit": (layer(0, [-1], 9, "Conv", [64, 6, 2]), "cannot be repeated"),
    "a million repeats": (layer(2, [-1], 10**6, "C3", [64]), "the number of layer 2"),
    "shortcut of 2": (layer(2, [-1], 3, "C3", [64, 2]), "not supported"),
    "layer that reads itself": (layer(0, [0], 1, "Conv", [64, 6, 2]), "the input of layer 0"),
    "layer that reads what comes before the first": (layer(1, [-3], 1, "Conv", [8]), "the input of layer 1"),
    "layer that reads nothing": (layer(1, [], 1, "Conv", [64, 3, 2]), "reads 0 layers"),
    "sizes that differ": (layer(6, [-1, 0], 1, "Concat", []), "joins layers of different"),
    "no head": (layer(8, [-1], 1, "Conv", [64, 1, 1]), "expected one Detect or"),
    "many prototypes": (
        layer(8, [7, 4], 1, "Segment", [257, 64]),
        "coefficients of masks of layer 8: expected an integer from 1 to 256",
    ),
    "masks that are not there": (
        layer(8, [7, 4], 1, "Segment", [8, 64]),
        "model.8.m.0.weight has the shape",
    ),
}
