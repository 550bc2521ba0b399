"""Memory and processors: what this process has and may have, heap tuning and release to the system."""

from __future__ import annotations

import ctypes
import os
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

_STATISTICS = Path("/proc/self/statm")  # in pages: the address space, then the resident set
_MIB = 1 << 20
_LIBC = ctypes.CDLL(None)
_TRIM_THRESHOLD = (-1, 256 * _MIB)
_MMAP_THRESHOLD = (-3, 32 * _MIB)  # the maximum accepted by glibc; a 4K image has 24 MiB
_ARENA_MAX = (-8, 1)

Read = Callable[[str], str]
"""The text of a file of the machine; "" if it cannot be read."""


def resident_mb() -> float:
    """Resident memory of this process in units of 2**20 bytes."""
    return int(_STATISTICS.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / _MIB


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


def _text_of(name: str) -> str:
    try:
        return Path(name).read_text(encoding="ascii")
    except (OSError, ValueError):
        return ""


def available_bytes(read: Read = _text_of) -> int | None:
    """Memory of the machine that is available without swapping; None if it is not known."""
    found = re.search(r"^MemAvailable: *(\d+) kB", read("/proc/meminfo"), re.MULTILINE)
    return int(found[1]) << 10 if found else None


def cores(read: Read = _text_of) -> float | None:
    """How many processors this process may use on average; None without a limit."""
    limits = (text.split() for text in _limits(read, "cpu.max"))
    return min((int(quota_us) / int(period_us) for quota_us, period_us in limits), default=None)


def memory_bytes(read: Read = _text_of) -> int | None:
    """How much memory all processes of the group may use together; None without a limit."""
    return min(map(int, _limits(read, "memory.max")), default=None)


def _limits(read: Read, name: str) -> Iterator[str]:
    """The file `name` of this process's control group (version 2) and of those around it, where it limits."""
    found = re.search(r"^0::(/.*)$", read("/proc/self/cgroup"), re.MULTILINE)
    group = PurePosixPath(found[1] if found else "/")
    for folder in (group, *group.parents):
        text = read(f"/sys/fs/cgroup{folder}/{name}")
        if text and not text.startswith("max"):
            yield text
