"""Flushing of denormal floats to zero: CPUs compute them ten times slower, and weights can force them."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def denormals_as_zero() -> Iterator[None]:
    """Flush denormal floats to zero in this thread, where the CPU supports it."""
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
