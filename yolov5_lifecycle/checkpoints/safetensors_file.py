"""Models in .safetensors files: tensors, with architecture and class names as metadata."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, replace
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load, save

from yolov5_lifecycle.atomic_file import atomic_write
from yolov5_lifecycle.checkpoints.yaml_architecture import (
    MAX_ANCHORS,
    MAX_LEVELS,
    architecture_of,
)
from yolov5_lifecycle.models.architecture import AnchorsPx, Architecture, Argument
from yolov5_lifecycle.models.convolutions import activation_of
from yolov5_lifecycle.models.cost import MAX_STRIDE
from yolov5_lifecycle.models.model import (
    MAX_CLASSES,
    Model,
    WeightsError,
    check_class_names,
    checked_integer,
    checked_model,
    first_line,
    shown,
)

FORMAT = "yolov5_lifecycle 1"
MAX_HEADER_BYTES = 16 << 20
MAX_VALUES = 500_000
"""Of a JSON text, by its commas and brackets; an object of a few bytes takes up hundreds in memory."""


def write_safetensors(model: Model, path: Path) -> None:
    """Write `model` to `path` atomically; floats are stored as fp16 where that is lossless."""
    tensors = {key: _smallest(tensor) for key, tensor in model.state_dict.items()}
    metadata = {
        "format": FORMAT,
        "architecture": json.dumps(_described(model.architecture)),
        "class_names": json.dumps(model.class_names),
    }
    atomic_write(path, _repeatable(save(tensors, metadata=metadata)))


def _repeatable(data: bytes) -> bytes:
    """The same file with sorted metadata: safetensors shuffles it, but equal models need equal digests."""
    end = 8 + struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + data[end:]


def _described(architecture: Architecture) -> dict[str, Any]:
    """The architecture as JSON, with booleans normalized to integers, without fields that have defaults."""
    described = asdict(architecture) | {
        "layers": [
            [layer.sources, layer.repeats, layer.kind, list(map(_number, layer.args))]
            for layer in architecture.layers
        ],
    }
    usual = {field.name: field.default for field in fields(architecture) if field.name != "layers"}
    return {name: value for name, value in described.items() if value != usual.get(name, MISSING)}


def _number(argument: Argument) -> Argument:
    return int(argument) if isinstance(argument, bool) else argument


def read_safetensors(data: bytes) -> Model:
    """The model in the bytes of a file written by `write_safetensors`; raises WeightsError."""
    metadata = _header(data).get("__metadata__")
    if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
        raise WeightsError(
            "this .safetensors file was not written by this package, so it lacks the architecture: "
            "convert the original .pt with `convert IN.pt OUT.safetensors`"
        )
    architecture = _architecture(_json(metadata, "architecture"))
    class_names = check_class_names(
        _json(metadata, "class_names"), architecture.classes, remedy="convert the original .pt again"
    )
    return checked_model(architecture, class_names, _tensors(data))


def _header(data: bytes) -> dict[str, Any]:
    if len(data) < 8:
        raise WeightsError(f"expected a .safetensors file, found {len(data)} bytes")
    (header_bytes,) = struct.unpack("<Q", data[:8])
    if header_bytes > min(MAX_HEADER_BYTES, len(data) - 8):
        raise WeightsError("this is not a .safetensors file, or it is cut short: its header does not fit")
    try:
        header = _parsed(data[8 : 8 + header_bytes].decode())
    except (ValueError, RecursionError):
        raise WeightsError(
            f"this is not a .safetensors file: its header is not JSON of at most {MAX_VALUES} values"
        ) from None
    if not isinstance(header, dict):
        raise WeightsError(f"this is not a .safetensors file: its header is {shown(header)}")
    return header


def _tensors(data: bytes) -> Mapping[str, torch.Tensor]:
    try:
        return load(data)
    except Exception as error:  # noqa: BLE001 - any error of a hostile file means rejection
        raise WeightsError(
            f"the file is damaged, or cut short ({first_line(error)}): copy it again"
        ) from None


def _smallest(tensor: torch.Tensor) -> torch.Tensor:
    half = tensor.half() if tensor.dtype is torch.float32 else tensor
    return half if torch.equal(half.to(tensor.dtype), tensor) else tensor


def _json(metadata: Mapping[str, Any], key: str) -> Any:
    try:
        return _parsed(str(metadata.get(key, "")))
    except (ValueError, RecursionError):
        raise WeightsError(
            f"the metadata entry {key} is missing or damaged, or has more than {MAX_VALUES} values: "
            "convert the original .pt again"
        ) from None


def _parsed(text: str) -> Any:
    """The value of a JSON text; raises ValueError, also for more than `MAX_VALUES`, or RecursionError."""
    if sum(map(text.count, ",[{")) > MAX_VALUES:
        raise ValueError("too many values")
    return json.loads(text)


def _architecture(described: Any) -> Architecture:
    """An Architecture from its JSON, validated like the yaml of a checkpoint."""
    try:
        rows = [
            [sources, repeats, kind, _yaml_arguments(str(kind), list(args))]
            for sources, repeats, kind, args in described["layers"]
        ]
        strides = tuple(
            checked_integer(stride, "a stride", 1, MAX_STRIDE)
            for stride in described["strides"][: MAX_LEVELS + 1]
        )
        anchors_px: AnchorsPx = tuple(
            tuple((float(width), float(height)) for width, height in level)
            for level in described["anchors_px"]
        )
        classes = checked_integer(described["classes"], "the number of classes", 1, MAX_CLASSES)
    except WeightsError:
        raise
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise WeightsError(f"the metadata entry architecture is damaged ({first_line(error)})") from None
    counts = {len(level) for level in anchors_px}
    if not 1 <= len(anchors_px) == len(strides) <= MAX_LEVELS or len(counts) != 1:
        raise WeightsError("expected a stride and equally many anchors for each of 1 to 8 levels")
    checked_integer(counts.pop(), "the anchors of a level", 1, MAX_ANCHORS)
    channels = described.get("image_channels", Architecture.image_channels)
    yaml = described | {"backbone": rows, "head": [], "ch": channels}
    architecture = architecture_of(yaml, classes=classes, anchors_px=anchors_px, strides=strides)
    return replace(architecture, **_activations(described))


def _activations(described: dict[str, Any]) -> dict[str, Any]:
    """The fields of an Architecture that a yaml lacks."""
    others, is_fused = described.get("other_activations", []), described.get("is_fused", False)
    if not isinstance(others, list) or not all(isinstance(pair, list) and len(pair) == 2 for pair in others):
        raise WeightsError(f"expected pairs of paths and activations, found {shown(others)}")
    if not isinstance(is_fused, bool):
        raise WeightsError(f"expected true or false as is_fused, found {shown(is_fused)}")
    return {
        "activation": _activation(described.get("activation", Architecture.activation)),
        "other_activations": tuple((str(path), _activation(name)) for path, name in others),
        "is_fused": is_fused,
    }


def _activation(name: object) -> str:
    try:
        activation_of(str(name))
    except ValueError as error:
        raise WeightsError(str(error)) from None
    return str(name)


def _yaml_arguments(kind: str, args: list[Any]) -> list[Any]:
    """The arguments of a `Layer` as a yaml has them.

    There Conv has another default of its padding, and Segment begins with classes and anchors.
    """
    if kind == "Segment":
        return ["nc", "anchors", *args]
    if kind != "Conv" or not args or not all(isinstance(side, int) for side in args[1:2] + args[5:6]):
        return args
    filled = args + [1, 1, None, 1, 1][len(args) - 1 :]
    if filled[3] is None:
        filled[3] = filled[5] * (filled[1] - 1) // 2
    return filled
