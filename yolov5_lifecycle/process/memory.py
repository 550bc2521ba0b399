"""Process memory: measurement, heap tuning and release to the operating system."""

from __future__ import annotations

import ctypes
import os
import sys
from pathlib import Path

_STATISTICS = Path("/proc/self/statm")  # in pages: the address space, then the resident set
_MACHINE = Path("/proc/meminfo")  # in KiB
_MIB = 1 << 20
_LIBC = ctypes.CDLL(None)
_TRIM_THRESHOLD = (-1, 256 * _MIB)
_MMAP_THRESHOLD = (-3, 32 * _MIB)  # the maximum accepted by glibc; a 4K image has 24 MiB
_ARENA_MAX = (-8, 1)


def resident_mb() -> float:
    """Resident memory of this process in units of 2**20 bytes."""
    return int(_STATISTICS.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / _MIB


def available_bytes(path: Path = _MACHINE) -> int | None:
    """Memory of the machine that is available without swapping; None without `path`."""
    try:
        lines = path.read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:")), None)


def prepare_heap() -> None:
    """Tune glibc's heap for large images and models; call before any thread is started.

    All threads share one arena: malloc_trim does not trim the top of other arenas, up to 64 MB each. Freed
    memory is kept until `trim_heap`: otherwise most of it is returned to the system after every image and
    mapped again page by page, which costs 2 ms for the copies of a 1280x720 image.
    """
    for option, value in (_ARENA_MAX, _MMAP_THRESHOLD, _TRIM_THRESHOLD):
        _LIBC.mallopt(option, value)


def trim_heap() -> None:
    """Return free heap memory to the operating system."""
    _LIBC.malloc_trim(0)


def release_unused_memory() -> None:
    """Empty the caches that hold the memory of freed tensors: CUDA's caching allocator and the heap.

    The CUDA context itself (a few hundred MB) stays until the process ends.
    """
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    trim_heap()
