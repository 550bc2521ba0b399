"""A tensor described by a checkpoint's pickle, before its data is read."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from yolov5_lifecycle.models.model import WeightsError, shown

MAX_DIMENSIONS = 16
_MAX_SIZE = 1 << 62


@dataclass(frozen=True)
class Storage:
    """`elements` values of `dtype` in the record `key`."""

    key: str
    dtype: torch.dtype
    elements: int

    def __post_init__(self) -> None:
        _check_numbers(self.elements)

    @property
    def size_bytes(self) -> int:
        return self.elements * self.dtype.itemsize


@dataclass(frozen=True)
class StoredTensor:
    """A view of `storage` with this offset, shape and strides.

    Raises WeightsError if it exceeds the storage.
    """

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]

    def __post_init__(self) -> None:
        _check_numbers(self.offset, *self.shape, *self.strides)
        if len(self.shape) != len(self.strides) or len(self.shape) > MAX_DIMENSIONS:
            raise WeightsError(f"the pickle cannot be read: a tensor has the strides {shown(self.strides)}")
        if math.prod(max(size, 1) for size in self.shape) >= _MAX_SIZE:
            raise WeightsError(f"the pickle cannot be read: a tensor has the shape {shown(self.shape)}")
        steps = zip(self.shape, self.strides, strict=True)
        last = self.offset + sum((size - 1) * stride for size, stride in steps)
        if 0 not in self.shape and last >= self.storage.elements:
            raise WeightsError(
                f"the tensors claim more than the file has: number {last} of {self.storage.elements}"
            )

    @property
    def dtype(self) -> torch.dtype:
        return self.storage.dtype

    @property
    def size_bytes(self) -> int:
        """Size of the tensor in memory."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def repeats_numbers(self) -> bool:
        """Whether elements may overlap in the storage."""
        return any(stride == 0 for stride, size in zip(self.strides, self.shape, strict=True) if size > 1)

    def on_meta(self) -> Tensor:
        """A meta tensor of the same shape and dtype, without data."""
        return torch.empty(self.shape, dtype=self.dtype, device="meta")

    def of(self, content: memoryview) -> Tensor:
        """The tensor as a view of `content`, the writable bytes of the storage. Raises WeightsError."""
        if len(content) != self.storage.size_bytes:
            raise WeightsError(
                f"the storage {shown(self.storage.key)} has {len(content)} bytes, "
                f"its tensors claim {self.storage.size_bytes}: copy the file again"
            )
        if not content:
            return torch.empty(self.shape, dtype=self.dtype)
        numbers = torch.frombuffer(content, dtype=self.dtype)
        return numbers.as_strided(self.shape, self.strides, self.offset)


def _check_numbers(*numbers: object) -> None:
    for number in numbers:
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < _MAX_SIZE:
            raise WeightsError(f"the pickle cannot be read: a tensor has the size {shown(number)}")
