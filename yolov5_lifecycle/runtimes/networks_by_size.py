"""Networks by input size: made on first use, run with denormal floats flushed to zero, freed on close."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

import torch

from yolov5_lifecycle.runtimes.runtime import InferenceError

Made = TypeVar("Made")
SizeHw = tuple[int, int]

_SIZES_KEPT = 4  # each holds as much memory as a network; a node sees one size per camera resolution


class NetworksBySize(Generic[Made]):
    """The networks that `make` returns for a height and width; keeps those of the sizes used last."""

    def __init__(self, make: Callable[[SizeHw], Made]) -> None:
        self._cache: _SizeCache[Made] | None = _SizeCache(make)

    @contextmanager
    def running(self, size_hw: SizeHw) -> Iterator[Made]:
        """The network for frames of `size_hw`; in this thread denormal floats are zero meanwhile.

        Raises the errors of `make`, and InferenceError once closed.
        """
        cache = self._cache  # an abandoned thread may run while another closes
        if cache is None:
            raise InferenceError("The runtime was closed; load the model again.")
        with denormals_as_zero():
            yield cache[size_hw]

    def close(self) -> None:
        """Free the networks. Idempotent."""
        self._cache = None


class _SizeCache(Generic[Made]):
    """Caches the result of `make` for a height and width; evicts the least recently used."""

    def __init__(self, make: Callable[[SizeHw], Made]) -> None:
        self._make = make
        self._kept: dict[SizeHw, Made] = {}

    def __getitem__(self, size_hw: SizeHw) -> Made:
        """The cached value, made if needed; raises the errors of `make`."""
        made = self._kept.pop(size_hw, None)
        if made is None:
            while len(self._kept) >= _SIZES_KEPT:
                del self._kept[next(iter(self._kept))]
            made = self._make(size_hw)
        self._kept[size_hw] = made
        return made


@contextmanager
def denormals_as_zero() -> Iterator[None]:
    """Flush denormal floats to zero in this thread, where the CPU supports it.

    CPUs compute them ten times slower, and weights can force them.
    """
    was_on = are_zero()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(was_on)


def are_zero() -> bool:
    """Whether this thread flushes denormal floats to zero; torch can set the mode but not query it."""
    smallest = sys.float_info.min
    return smallest / 2 == 0
