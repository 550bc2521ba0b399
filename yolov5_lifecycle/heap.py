"""glibc's heap; elsewhere nothing is done."""

from __future__ import annotations

import ctypes
import sys
from typing import Any

_MIB = 1 << 20
_TRIM_THRESHOLD = (-1, 256 * _MIB)
_MMAP_THRESHOLD = (-3, 32 * _MIB)  # the most that glibc accepts; a 4K image has 24
_ARENA_MAX = (-8, 1)


def prepare_heap() -> None:
    """Make the heap one for large images and models; to be called before there are threads.

    All threads share one heap: those of the others would never be given back whole, as malloc_trim leaves the
    top of each alone, up to 64 MB. And freed memory is kept until `trim_heap`: else much of it goes back to
    the system with every image and comes anew, page by page, 2 ms for the copies of 1280x720.
    """
    if (mallopt := _function("mallopt")) is not None:
        for option, value in (_ARENA_MAX, _MMAP_THRESHOLD, _TRIM_THRESHOLD):
            mallopt(option, value)


def trim_heap() -> None:
    """Give memory that is free back to the operating system."""
    if (trim := _function("malloc_trim")) is not None:
        trim(0)


def _function(name: str) -> Any:
    """A function of the C library, None where it has none of this name, as musl."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
