"""Networks by input shape: created on first use, run with denormals flushed to zero, freed on close."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from typing import Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.runtimes.runtime import InferenceError

Made = TypeVar("Made")
Shape = tuple[int, int, int]
"""Number of frames in a batch, their height and their width."""

KEPT_PER_CAMERA = 2
MIN_KEPT = 4
"""Min number of networks to keep; each takes as much memory as the weights."""


def closed() -> InferenceError:
    """The error of a runtime that was closed."""
    return InferenceError("The runtime was closed; load the model again.")


class NetworksByShape(Generic[Made]):
    """Networks created by `make`, one per batch shape; keeps the `kept` most recently used ones."""

    def __init__(self, make: Callable[[Shape], Made], *, kept: int = MIN_KEPT) -> None:
        self._cache: _ShapeCache[Made] | None = _ShapeCache(make, kept)

    @contextmanager
    def running(self, shape: Shape) -> Iterator[Made]:
        """The network for batches of `shape`; in the block, this thread flushes denormal floats to zero.

        Raises the errors of `make`, and InferenceError once closed.
        """
        cache = self._open()
        with denormals_as_zero():
            yield cache[shape]

    def keep_batches(self, sizes: Collection[int]) -> None:
        """Free the networks for batches of other `sizes`, except those for single frames."""
        if self._cache is not None:
            self._cache.keep_batches({1, *sizes})

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

    def keep_batches(self, sizes: Collection[int]) -> None:
        self._kept = {shape: made for shape, made in self._kept.items() if shape[0] in sizes}


def shape_of_batch(
    frames: Sequence[NDArray[np.uint8]], orders: Sequence[Order], min_objectness: Sequence[float]
) -> Shape:
    """Number, height and width of `frames`; raises ValueError like `Runtime.run_batch`."""
    shapes = {frame.shape[:2] for frame in frames}
    if len(shapes) != 1 or not len(frames) == len(orders) == len(min_objectness):
        raise ValueError(
            "A batch needs frames of one shape, each with an order and an objectness, found "
            f"{len(frames)} of shapes {sorted(shapes)}, {len(orders)} orders, {len(min_objectness)} numbers."
        )
    ((height, width),) = shapes
    return len(frames), height, width


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
