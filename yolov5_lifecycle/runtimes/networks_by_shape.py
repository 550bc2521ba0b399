"""Networks by input shape: created on first use, run with denormals flushed to zero, freed on close."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

import torch

from yolov5_lifecycle.runtimes.runtime import InferenceError

Made = TypeVar("Made")
Shape = tuple[int, int]
"""Height and width of a frame."""

KEPT_PER_CAMERA = 2
MIN_KEPT = 4
"""Min number of networks to keep; each takes as much memory as the weights."""


def closed() -> InferenceError:
    """The error of a runtime that was closed."""
    return InferenceError("The runtime was closed; load the model again.")


class NetworksByShape(Generic[Made]):
    """Networks created by `make`, one per shape of frames; keeps the `kept` most recently used ones."""

    def __init__(self, make: Callable[[Shape], Made], *, kept: int = MIN_KEPT) -> None:
        self._cache: _ShapeCache[Made] | None = _ShapeCache(make, kept)

    @contextmanager
    def running(self, shape: Shape) -> Iterator[Made]:
        """The network for frames of `shape`; in the block, this thread flushes denormal floats to zero.

        Raises the errors of `make`, and InferenceError once closed.
        """
        cache = self._open()
        with denormals_as_zero():
            yield cache[shape]

    def close(self) -> None:
        """Free the networks. Idempotent."""
        self._cache = None

    def _open(self) -> _ShapeCache[Made]:
        cache = self._cache  # an abandoned thread may run while another closes
        if cache is None:
            raise closed()
        return cache


class _ShapeCache(Generic[Made]):
    """Caches the result of `make` for a shape; evicts the least recently used."""

    def __init__(self, make: Callable[[Shape], Made], kept: int) -> None:
        self._make = make
        self._max_kept = kept
        self._kept: dict[Shape, Made] = {}

    def __getitem__(self, shape: Shape) -> Made:
        """The cached value, created if missing; raises the errors of `make`."""
        made = self._kept.pop(shape, None)
        if made is None:
            while len(self._kept) >= self._max_kept:
                del self._kept[next(iter(self._kept))]
            made = self._make(shape)
        self._kept[shape] = made
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
