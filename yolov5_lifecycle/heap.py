"""glibc's heap; elsewhere nothing is done."""

from __future__ import annotations

import ctypes
import sys
from typing import Any

_M_ARENA_MAX = -8


def keep_one_heap() -> None:
    """Let all threads share one heap, before there are any: the others' would never be given back whole.

    malloc_trim leaves the top of a thread's own heap alone, up to 64 MB each.
    """
    if (mallopt := _function("mallopt")) is not None:
        mallopt(_M_ARENA_MAX, 1)


def trim_heap() -> None:
    """Give memory that is free back to the operating system."""
    if (trim := _function("malloc_trim")) is not None:
        trim(0)


def _function(name: str) -> Any:
    """A function of the C library, None where it has none of this name, as musl."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
