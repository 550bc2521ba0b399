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
from safetensors.torch import save

from support.checkpoint_builder import SMALL
from support.random_model import random_model
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors


@functools.cache
def valid() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "valid.safetensors"
        write_safetensors(random_model(0, SMALL), path)
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

    def change(entries: dict[str, Any]) -> None:
        described = json.loads(entries["__metadata__"]["architecture"])
        entries["__metadata__"]["architecture"] = json.dumps(described | changes)

    return header(change)


def arguments(layer: int, changed: list[int]) -> Callable[[], bytes]:
    """A valid file whose architecture has other arguments for `layer`."""

    def change(entries: dict[str, Any]) -> None:
        described = json.loads(entries["__metadata__"]["architecture"])
        described["layers"][layer][-1] = changed
        entries["__metadata__"]["architecture"] = json.dumps(described)

    return header(change)


def first_tensor(**changes: object) -> Callable[[], bytes]:
    return header(lambda entries: entries["model.0.conv.weight"].update(changes))


def number_in_first_tensor(value: float) -> bytes:
    entries, tensors = parted(valid())
    entry = entries["model.0.conv.weight"]
    assert entry["dtype"] == "F32"
    start = entry["data_offsets"][0]
    return joined(entries, tensors[:start] + struct.pack("<f", value) + tensors[start + 4 :])


def overlapping(entries: dict[str, Any]) -> None:
    entries["model.0.bn.bias"]["data_offsets"] = entries["model.0.bn.weight"]["data_offsets"]


def overlapping_by_name(entries: dict[str, Any]) -> None:
    entries["\x1b[2J"] = {"dtype": "F32", "shape": [1], "data_offsets": [4, 8]}


def deep_json() -> bytes:
    text = b"[" * 100_000
    return struct.pack("<Q", len(text)) + text


def escaped_objects() -> bytes:
    """The text of the header does not show how many there are."""
    text, tensors = cut(metadata(architecture="[@0]")())
    return glued(text.replace(b"@", rb"\u007b\"\":0}\u002c" * 800_000), tensors)


FILES: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "found 0 bytes"),
    "header of 16 EiB": (lambda: b"\xff" * 8 + b"{}", "its header does not fit"),
    "header of 17 MiB": (lambda: struct.pack("<Q", 17 << 20) + bytes(17 << 20), "its header does not fit"),
    "first half": (lambda: valid()[: len(valid()) // 2], "cut short"),
    "only the header": (lambda: joined(parted(valid())[0], b""), "damaged, or cut short"),
    "trailing bytes": (lambda: valid() + b"more", "damaged, or cut short"),
    "JSON, 100,000 deep": (deep_json, "its header is not JSON"),
    "foreign file": (
        lambda: save({"weight": torch.ones(3)}, {"format": "pt"}),
        "not written by this package",
    ),
    "overlapping tensors": (header(overlapping), "damaged, or cut short"),
    "tensor beyond the end": (first_tensor(data_offsets=[0, 1 << 40]), "damaged, or cut short"),
    "tensor that ends before it begins": (first_tensor(data_offsets=[100, 0]), "damaged, or cut short"),
    "tensor of negative offset": (first_tensor(data_offsets=[-8, 0]), "damaged, or cut short"),
    "name that clears the screen": (header(overlapping_by_name), "belongs to no layer"),
    "tensor of 16 Ti numbers": (first_tensor(shape=[1 << 22, 1 << 22]), "has the shape (4194304, 4194304)"),
    "tensor of negative size": (first_tensor(shape=[-1]), "has the shape [-1]"),
    "weight NaN": (lambda: number_in_first_tensor(math.nan), "not finite"),
    "architecture, 100,000 deep": (metadata(architecture="[" * 100_000), "entry architecture is missing"),
    "a number of 10,000 digits": (metadata(architecture="9" * 10_000), "entry architecture is missing"),
    "201 layers": (
        architecture(layers=[[[-1], 1, "Conv", [64]]] * 201),
        "expected 1 to 200 layers, found 201",
    ),
    "a million channels": (architecture(layers=[[[-1], 1, "Conv", [1_000_000]]]), "the channels of layer 0"),
    "even window": (arguments(4, [64, 4]), "has the arguments [64, 4]"),
    "a million repeats": (architecture(layers=[[[-1], 1_000_000, "C3", [64]]]), "the number of layer 0"),
    "100,000 strides": (architecture(strides=[8] * 100_000), "equally many anchors"),
    "header of two million objects": (
        lambda: glued(b'{"x":[' + b'{"":0},' * 2_000_000 + b"0]}", b""),
        "not JSON of at most 500000 values",
    ),
    "architecture of 800,000 objects, escaped": (escaped_objects, "has more than 500000 values"),
    "class names that are lists": (
        metadata(class_names='["a", [], "c"]'),
        "found a list: convert the original",
    ),
}
