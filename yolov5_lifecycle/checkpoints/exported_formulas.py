"""Predictions of an exported network as formulas: ranges of columns, each computed in its own way."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Union

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.checkpoints.stored_array import StoredArray


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns `first` to `end` of predictions: scale * value ** power + offset."""

    first: int
    end: int
    is_logistic: bool = False
    power: int = 1
    scale: NDArray[Any] = field(default_factory=lambda: np.array(1, np.float32))
    offset: NDArray[Any] = field(default_factory=lambda: np.array(0, np.float32))

    @property
    def is_plain(self) -> bool:
        """Whether the value is as the convolution or the logistic function gives it."""
        return self.power == 1 and is_number(self.scale, 1) and is_number(self.offset, 0)


@dataclass(frozen=True)
class Level:
    """The predictions of a level of the head in one of its layouts.

    `layout` is "conv", (B, na * no, ny, nx), "split", (B, na, no, ny, nx), or "cells", (B, na, ny, nx, no).
    It has na anchors and no columns. Until it is split, the columns are not known.
    """

    number: int
    layout: str = "conv"
    anchors: int = 0
    columns: tuple[Columns, ...] = ()


@dataclass(frozen=True)
class Sizes:
    """Integers, None where they depend on the size of the images; no `values` if even their number does."""

    values: tuple[int | None, ...] | None = None


Rows = tuple[Level, ...]
"""Levels one after the other, (B, N, no)."""
Known = Union[Level, Rows, Sizes, StoredArray]  # noqa: UP007 - for 3.10


def is_number(numbers: NDArray[Any], expected: float) -> bool:
    """Whether the only one of `numbers` is `expected`."""
    return numbers.size == 1 and bool(numbers.item() == expected)


def numbers_of(numbers: NDArray[Any], part: Columns, columns: tuple[Columns, ...]) -> NDArray[Any]:
    """The numbers for `part` of `columns`."""
    first, width = columns[0].first, columns[-1].end - columns[0].first
    if numbers.ndim and numbers.shape[-1] == width:
        return numbers[..., part.first - first : part.end - first]
    return numbers


def cut(level: Level, first: int, end: int) -> Level:
    """Columns `first` to `end` of those of `level`, counted from its first one."""
    begin = level.columns[0].first
    columns = []
    for part in level.columns:
        low, high = max(part.first, begin + first), min(part.end, begin + end)
        if low < high:
            narrow = replace(part, first=low, end=high)
            whole = (part,)
            columns.append(
                replace(
                    narrow,
                    scale=numbers_of(part.scale, narrow, whole),
                    offset=numbers_of(part.offset, narrow, whole),
                )
            )
    return replace(level, columns=tuple(columns))
