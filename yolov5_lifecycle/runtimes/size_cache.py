"""What was made for frames of one size, kept for the next frame of that size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

Made = TypeVar("Made")

_SIZES_KEPT = 4  # each holds memory of a network's size; a node sees as many sizes as its cameras have


class SizeCache(Generic[Made]):
    """Keeps what `make` makes for a height and width; of the least recently used ones it lets go."""

    def __init__(self, make: Callable[[tuple[int, int]], Made]) -> None:
        self._make = make
        self._kept: dict[tuple[int, int], Made] = {}

    def __getitem__(self, size_hw: tuple[int, int]) -> Made:
        """Made now if need be; raises what making raises."""
        made = self._kept.pop(size_hw, None)
        if made is None:
            while len(self._kept) >= _SIZES_KEPT:
                del self._kept[next(iter(self._kept))]
            made = self._make(size_hw)
        self._kept[size_hw] = made
        return made
