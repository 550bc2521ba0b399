"""Models as .safetensors: tensors, and the architecture and class names as metadata."""

from __future__ import annotations

import json
import os
import struct
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from yolov5_lifecycle.architecture import AnchorsPx, Architecture
from yolov5_lifecycle.model import MAX_CLASSES, Model, WeightsError, check_class_names, checked_model
from yolov5_lifecycle.yaml_architecture import architecture_of

FORMAT = "yolov5_lifecycle 1"
MAX_HEADER_BYTES = 16 << 20


def write_safetensors(model: Model, path: Path) -> None:
    """Write `model` to `path`, whole or not at all; floats are stored as fp16 where that loses nothing."""
    tensors = {key: _smallest(tensor) for key, tensor in model.state_dict.items()}
    metadata = {
        "format": FORMAT,
        "architecture": json.dumps(_described(model.architecture)),
        "class_names": json.dumps(model.class_names),
    }
    _write_whole(path, _repeatable(save(tensors, metadata=metadata)))


def _repeatable(data: bytes) -> bytes:
    """The same file, its metadata sorted: safetensors shuffles it, and equal models shall have equal digests."""
    end = 8 + struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + data[end:]


def _described(architecture: Architecture) -> dict[str, Any]:
    """The architecture as JSON has it, with 1 and 1.0, or 0 and False, written alike."""
    return asdict(architecture) | {
        "anchors_px": [[list(map(float, anchor)) for anchor in level] for level in architecture.anchors_px],
        "layers": [
            [layer.sources, layer.repeats, layer.kind, list(map(int, layer.args))]
            for layer in architecture.layers
        ],
    }


def _write_whole(path: Path, data: bytes) -> None:
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".part")
    unfinished = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(descriptor)
        unfinished.chmod(0o644)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)


def read_safetensors(data: bytes) -> Model:
    """The model in the bytes of a file that `write_safetensors` wrote; raises WeightsError."""
    metadata = _metadata(data)
    if metadata.get("format") != FORMAT:
        raise WeightsError(
            "this .safetensors file was not made by this package, so it does not tell the architecture: "
            "convert the original .pt with `convert IN.pt OUT.safetensors`"
        )
    try:
        tensors = load(data)
    except (SafetensorError, ValueError, KeyError, OverflowError) as error:
        raise WeightsError(f"the file is damaged or cut short ({str(error)[:200]}): copy it again") from None
    architecture = _architecture(_json(metadata, "architecture"))
    return checked_model(
        architecture, check_class_names(_json(metadata, "class_names"), architecture.classes), tensors
    )


def _smallest(tensor: torch.Tensor) -> torch.Tensor:
    half = tensor.half() if tensor.dtype is torch.float32 else tensor
    return half if torch.equal(half.to(tensor.dtype), tensor) else tensor


def _metadata(data: bytes) -> Mapping[str, Any]:
    if len(data) < 8:
        raise WeightsError(f"expected a .safetensors file, found {len(data)} bytes")
    (header_bytes,) = struct.unpack("<Q", data[:8])
    if header_bytes > min(MAX_HEADER_BYTES, len(data) - 8):
        raise WeightsError("this is no .safetensors file, or it is cut short: its header does not fit")
    try:
        header = json.loads(data[8 : 8 + header_bytes])
    except (ValueError, RecursionError):
        raise WeightsError("this is no .safetensors file: its header is no JSON") from None
    metadata = header.get("__metadata__", {}) if isinstance(header, dict) else {}
    return metadata if isinstance(metadata, dict) else {}


def _json(metadata: Mapping[str, Any], key: str) -> Any:
    try:
        return json.loads(metadata.get(key, ""))
    except (TypeError, ValueError, RecursionError):
        raise WeightsError(
            f"the metadata entry {key} is missing or damaged: convert the original .pt again"
        ) from None


def _architecture(described: Any) -> Architecture:
    """An Architecture from its JSON, with the checks that a checkpoint's yaml has to pass."""
    try:
        rows = [
            [list(sources), repeats, kind, _yaml_arguments(kind, args)]
            for sources, repeats, kind, args in described["layers"]
        ]
        classes, strides = described["classes"], tuple(described["strides"])
        anchors_px: AnchorsPx = tuple(
            tuple((float(width), float(height)) for width, height in level)
            for level in described["anchors_px"]
        )
    except (TypeError, ValueError, KeyError) as error:
        raise WeightsError(f"the metadata entry architecture is damaged ({str(error)[:80]})") from None
    if not isinstance(classes, int) or not 1 <= classes <= MAX_CLASSES:
        raise WeightsError(f"the model has {str(classes)[:40]} classes, expected 1 to {MAX_CLASSES}")
    if not all(isinstance(stride, int) and 1 <= stride <= 1024 for stride in strides) or not strides:
        raise WeightsError(f"the strides {str(strides)[:80]} are not whole numbers from 1 to 1024")
    if len(anchors_px) != len(strides) or len({len(level) for level in anchors_px}) != 1:
        raise WeightsError("expected as many anchors on each level, and as many levels as strides")
    yaml = described | {"backbone": rows, "head": []}
    return architecture_of(yaml, classes=classes, anchors_px=anchors_px, strides=strides)


def _yaml_arguments(kind: str, args: list[Any]) -> list[Any]:
    """What a yaml row says where a `Layer` of this kind says nothing."""
    implied: dict[str, list[Any]] = {"Upsample": [None, 2, "nearest"], "Concat": [1]}
    return implied.get(kind, list(args))
