"""LRU cache by frame size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

Made = TypeVar("Made")

_SIZES_KEPT = 4  # each holds as much memory as a network; a node sees one size per camera resolution


class SizeCache(Generic[Made]):
    """Caches the result of `make` for a height and width; evicts the least recently used."""

    def __init__(self, make: Callable[[tuple[int, int]], Made]) -> None:
        self._make = make
        self._kept: dict[tuple[int, int], Made] = {}

    def __getitem__(self, size_hw: tuple[int, int]) -> Made:
        """The cached value, made if needed; raises the errors of `make`."""
        made = self._kept.pop(size_hw, None)
        if made is None:
            while len(self._kept) >= _SIZES_KEPT:
                del self._kept[next(iter(self._kept))]
            made = self._make(size_hw)
        self._kept[size_hw] = made
        return made
