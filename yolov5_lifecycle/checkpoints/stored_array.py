"""An array in an ONNX file, before its numbers are read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from yolov5_lifecycle.checkpoints.protobuf_fields import (
    ProtobufReader,
    Value,
    damaged,
    integer,
    nested,
    text,
)
from yolov5_lifecycle.checkpoints.stored_tensor import MAX_DIMENSIONS
from yolov5_lifecycle.models.model import WeightsError, shown

_DTYPES: Mapping[int, str] = MappingProxyType(
    {1: "<f4", 2: "|u1", 3: "|i1", 6: "<i4", 7: "<i8", 9: "|b1", 10: "<f2", 11: "<f8"}
)
"""By TensorProto.DataType."""
_WEIGHTS: Mapping[str, torch.dtype] = MappingProxyType(
    {"<f4": torch.float32, "<f2": torch.float16, "<f8": torch.float64}
)
_SHAPE, _KIND, _NAME, _CONTENT, _FILE, _LOCATION = 1, 2, 8, 9, 13, 14
_PACKED_FIELDS = (4, 5, 7, 10)
"""Fields of a TensorProto."""
_EXTERNAL = 1
_PACKED = {4: "<f4", 10: "<f8"}
"""The fields of an array for floating-point numbers that are not raw."""
_MAX_PACKED = 4096
"""Numbers of an array that are not raw; exports hold some constants in this way, but no weights."""


@dataclass(frozen=True)
class StoredArray:
    """Numbers of `dtype`, a numpy type, in `content`, which lies in the file or was unpacked from it."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    content: memoryview

    def __post_init__(self) -> None:
        if len(self.shape) > MAX_DIMENSIONS or min(self.shape, default=1) < 0:
            raise WeightsError(f"the array {shown(self.name)} has the shape {shown(self.shape)}")
        if math.prod(self.shape) * np.dtype(self.dtype).itemsize != len(self.content):
            raise WeightsError(
                f"the array {shown(self.name)} of shape {shown(self.shape)} has {len(self.content)} bytes: "
                "copy or export the file again"
            )

    @property
    def elements(self) -> int:
        return math.prod(self.shape)

    def on_meta(self) -> torch.Tensor:
        """A meta tensor of the same shape and dtype, without data; raises WeightsError for integers."""
        if self.dtype not in _WEIGHTS:
            raise WeightsError(f"the weights {shown(self.name)} hold {np.dtype(self.dtype)}: not supported")
        return torch.empty(self.shape, dtype=_WEIGHTS[self.dtype], device="meta")

    def numbers(self) -> NDArray[Any]:
        """A copy of the numbers, in the byte order of this machine."""
        stored = np.frombuffer(self.content, self.dtype).reshape(self.shape)
        return stored.astype(stored.dtype.newbyteorder("="))


def stored_array(reader: ProtobufReader, message: memoryview) -> StoredArray:
    """The array in a TensorProto; raises WeightsError."""
    shape: list[int] = []
    packed: list[tuple[int, Value]] = []
    found: dict[int, Value] = {}
    for number, value in reader.fields(message):
        if number in _PACKED_FIELDS:
            packed.append((number, value))
        elif number != _SHAPE:
            found[number] = value
        elif len(shape) < MAX_DIMENSIONS:
            shape.extend(reader.integers(value))
    name, kind = text(found.get(_NAME, memoryview(b""))), integer(found.get(_KIND, 0))
    if len(shape) >= MAX_DIMENSIONS:
        raise WeightsError(f"the array {shown(name)} has {len(shape)} dimensions: no weights of YOLOv5 have")
    if _FILE in found or found.get(_LOCATION) == _EXTERNAL:
        raise WeightsError(
            f"the numbers of {shown(name)} lie in another file, which is not opened: export the model again, "
            "as one file"
        )
    if kind not in _DTYPES:
        raise WeightsError(f"the array {shown(name)} holds numbers of kind {kind}: not supported")
    content = found.get(_CONTENT)
    if content is None:
        content = _unpacked(reader, packed, _DTYPES[kind], math.prod(shape))
    return StoredArray(name, _DTYPES[kind], tuple(shape), nested(content))


def _unpacked(
    reader: ProtobufReader, packed: list[tuple[int, Value]], dtype: str, elements: int
) -> memoryview:
    """The content of an array whose numbers are fields; weights are never stored in this way."""
    if elements > _MAX_PACKED:
        raise WeightsError(
            f"an array has {elements} numbers that are not raw, at most {_MAX_PACKED} are read: no export "
            "of YOLOv5 has"
        )
    parts: list[bytes] = []
    for number, value in packed:
        if number in _PACKED:
            if _PACKED[number] != dtype:
                raise damaged(f"an array of {dtype} in the numbers of another kind")
            parts.append(bytes(nested(value)[: _MAX_PACKED * 8 + 1]))
        elif np.dtype(dtype).kind == "f":
            raise damaged("an array of floating-point numbers in integers")
        else:
            parts.append(_integers(reader, value, dtype))
    return memoryview(b"".join(parts))


def _integers(reader: ProtobufReader, value: Value, dtype: str) -> bytes:
    limits = (0, 1) if dtype == "|b1" else (np.iinfo(dtype).min, np.iinfo(dtype).max)
    found = list(reader.integers(value))
    if any(not limits[0] <= number <= limits[1] for number in found):
        raise damaged(f"integers that are no {dtype}")
    return np.array(found, dtype).tobytes()
