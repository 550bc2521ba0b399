"""Files named .safetensors that must be refused."""

from __future__ import annotations

import json
import math
import struct
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from checkpoint_builder import SMALL
from random_model import random_model
from safetensors.torch import save

from yolov5_lifecycle.safetensors_file import write_safetensors


def valid() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "valid.safetensors"
        write_safetensors(random_model(0, SMALL), path)
        return path.read_bytes()


def parted(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Header and tensors of a file."""
    end = 8 + int.from_bytes(data[:8], "little")
    return json.loads(data[8:end]), data[end:]


def joined(header: object, tensors: bytes) -> bytes:
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + tensors


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


def first_tensor(**changes: object) -> Callable[[], bytes]:
    return header(lambda entries: entries["model.0.conv.weight"].update(changes))


def last_offset(entries: dict[str, Any]) -> int:
    return max(int(entry["data_offsets"][1]) for key, entry in entries.items() if key != "__metadata__")


def number_in_first_tensor(value: float) -> bytes:
    entries, tensors = parted(valid())
    entry = entries["model.0.conv.weight"]
    assert entry["dtype"] == "F32"
    start = entry["data_offsets"][0]
    return joined(entries, tensors[:start] + struct.pack("<f", value) + tensors[start + 4 :])


def overlapping(entries: dict[str, Any]) -> None:
    entries["model.0.bn.bias"]["data_offsets"] = entries["model.0.bn.weight"]["data_offsets"]


def deep_json() -> bytes:
    text = b"[" * 100_000
    return struct.pack("<Q", len(text)) + text


NO_LAYERS = "expected 1 to 200 layers, found 0"
FILES: Mapping[str, tuple[Callable[[], bytes], str]] = {
    "empty": (lambda: b"", "found 0 bytes"),
    "seven bytes": (lambda: b"1234567", "found 7 bytes"),
    "header of 16 EiB": (lambda: b"\xff" * 8 + b"{}", "its header does not fit"),
    "header of 17 MiB": (lambda: struct.pack("<Q", 17 << 20) + bytes(17 << 20), "its header does not fit"),
    "first half": (lambda: valid()[: len(valid()) // 2], "cut short"),
    "only the header": (lambda: joined(parted(valid())[0], b""), "damaged, or cut short"),
    "trailing bytes": (lambda: valid() + b"more", "damaged, or cut short"),
    "HTML page": (lambda: b"<!DOCTYPE html><html>Not Found</html>", "its header does not fit"),
    "no JSON": (lambda: struct.pack("<Q", 4) + b"{{{{", "its header is no JSON"),
    "JSON of another text": (lambda: struct.pack("<Q", 4) + b"\xff\xfe\xfd\xfc", "its header is no JSON"),
    "JSON list": (lambda: joined([1], b""), "its header is [1]"),
    "JSON, 100,000 deep": (deep_json, "its header is no JSON"),
    "no metadata": (header(lambda entries: entries.pop("__metadata__")), "not made by this package"),
    "metadata that are a list": (
        header(lambda entries: entries.update(__metadata__=[1])),
        "not made by this",
    ),
    "foreign file": (lambda: save({"weight": torch.ones(3)}, {"format": "pt"}), "not made by this package"),
    "other format": (metadata(format="yolov5_lifecycle 99"), "not made by this package"),
    "overlapping tensors": (header(overlapping), "damaged, or cut short"),
    "tensor beyond the end": (first_tensor(data_offsets=[0, 1 << 40]), "damaged, or cut short"),
    "tensor that ends before it begins": (first_tensor(data_offsets=[100, 0]), "damaged, or cut short"),
    "tensor of negative offset": (first_tensor(data_offsets=[-8, 0]), "damaged, or cut short"),
    "tensor of 16 Ti numbers": (first_tensor(shape=[1 << 22, 1 << 22]), "damaged, or cut short"),
    "tensor of negative size": (first_tensor(shape=[-1]), "damaged, or cut short"),
    "tensor of bytes": (first_tensor(dtype="U8"), "holds 'U8', expected one of F16"),
    "tensor of a kind that is not known": (first_tensor(dtype=["F32"]), "expected one of F16"),
    "tensor that is a text": (
        header(lambda entries: entries.update({"model.9": "x"})),
        "'model.9' holds None",
    ),
    "missing tensor": (header(lambda entries: entries.pop("model.0.conv.weight")), "damaged, or cut short"),
    "tensor of another name": (
        header(lambda entries: entries.update({"extra": entries.pop("model.0.conv.weight")})),
        "model.0.conv.weight is missing",
    ),
    "tensor more": (
        header(
            lambda entries: entries.update(
                extra={"dtype": "F32", "shape": [0], "data_offsets": [last_offset(entries)] * 2}
            )
        ),
        "'extra' belongs to no layer",
    ),
    "weight NaN": (lambda: number_in_first_tensor(math.nan), "not finite"),
    "weight infinite": (lambda: number_in_first_tensor(-math.inf), "not finite"),
    "architecture missing": (
        header(lambda entries: entries["__metadata__"].pop("architecture")),
        "entry architecture is",
    ),
    "architecture no JSON": (metadata(architecture="{"), "entry architecture is missing or damaged"),
    "architecture a number": (metadata(architecture=5), "entry architecture is missing or damaged"),
    "architecture a list": (metadata(architecture="[1, 2]"), "architecture is damaged (TypeError"),
    "architecture, 100,000 deep": (metadata(architecture="[" * 100_000), "entry architecture is missing"),
    "architecture empty": (metadata(architecture="{}"), "architecture is damaged (KeyError"),
    "a number of 10,000 digits": (metadata(architecture="9" * 10_000), "entry architecture is missing"),
    "layers a text": (architecture(layers="abc"), "architecture is damaged (ValueError"),
    "layer kind a list": (architecture(layers=[[[-1], 1, ["Conv"], [64]]]), "architecture is damaged"),
    "no layers": (architecture(layers=[]), NO_LAYERS),
    "201 layers": (
        architecture(layers=[[[-1], 1, "Conv", [64]]] * 201),
        "expected 1 to 200 layers, found 201",
    ),
    "unknown layer": (architecture(layers=[[[-1], 1, "os.system", [64]]]), "'os.system', not supported"),
    "a million channels": (architecture(layers=[[[-1], 1, "Conv", [1_000_000]]]), "the channels of layer 0"),
    "a million repeats": (architecture(layers=[[[-1], 1_000_000, "C3", [64]]]), "the number of layer 0"),
    "layer that reads itself": (architecture(layers=[[[0], 1, "Conv", [64]]]), "the input of layer 0"),
    "depth multiple infinite": (architecture(depth_multiple=math.inf), "depth_multiple from 0.01 to 10"),
    "no classes": (architecture(classes=0), "the number of classes"),
    "classes as a text": (architecture(classes="3"), "the number of classes"),
    "other classes": (architecture(classes=4), "expected names of 4 classes"),
    "stride zero": (architecture(strides=[0, 8]), "a stride: expected a whole number"),
    "strides as a number": (architecture(strides=8), "architecture is damaged (TypeError"),
    "a million strides": (architecture(strides=[8] * 1_000_000), "equally many anchors"),
    "other strides": (architecture(strides=[8, 16]), "but its layers make"),
    "no anchors": (architecture(anchors_px=[]), "equally many anchors"),
    "anchors of different number": (
        architecture(anchors_px=[[[1, 2]], [[1, 2], [3, 4]]]),
        "equally many anchors",
    ),
    "anchor of three sides": (architecture(anchors_px=[[[1, 2, 3]], [[1, 2, 3]]]), "architecture is damaged"),
    "anchor NaN": (architecture(anchors_px=[[[math.nan, 2], [3, 4]], [[1, 2], [3, 4]]]), "anchors"),
    "other anchors": (architecture(anchors_px=[[[1, 2], [3, 4]], [[1, 2], [3, 4]]]), "anchors"),
    "class names missing": (
        header(lambda entries: entries["__metadata__"].pop("class_names")),
        "class_names is missing",
    ),
    "class names no list": (metadata(class_names='"cat"'), "expected names of 3 classes"),
    "class name with a line break": (metadata(class_names='["a", "b\\n", "c"]'), "printable characters"),
    "two class names": (metadata(class_names='["a", "b"]'), "found 2 names"),
}
