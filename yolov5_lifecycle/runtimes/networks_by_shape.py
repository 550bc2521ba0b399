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
        self._make: Callable[[Shape], Made] | None = make
        """None once closed; it may hold the weights."""
        self._max_kept = kept
        self._networks: dict[Shape, Made] = {}

    @contextmanager
    def running(self, shape: Shape) -> Iterator[Made]:
        """The network for frames of `shape`; in the block, this thread flushes denormal floats to zero.

        Raises the errors of `make`, and InferenceError once closed.
        """
        networks, make = self._networks, self._make  # an abandoned thread may run while another closes
        if make is None:
            raise closed()
        with denormals_as_zero():
            found = networks.pop(shape, None)
            if found is None:
                while len(networks) >= self._max_kept:
                    del networks[next(iter(networks))]
                found = make(shape)
            networks[shape] = found
            yield found

    def close(self) -> None:
        """Free the networks. Idempotent."""
        self._make, self._networks = None, {}


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
