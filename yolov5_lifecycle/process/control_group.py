"""Limits that a container, systemd or a batch system sets for its processes: Linux control groups."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

_ROOT = "/sys/fs/cgroup"
Read = Callable[[str], str]
"""The text of a file of the machine; "" if it cannot be read."""


def text_of(name: str) -> str:
    """See `Read`."""
    try:
        return Path(name).read_text(encoding="ascii")
    except (OSError, ValueError):
        return ""


def cores(read: Read = text_of) -> float | None:
    """How many processors this process may use on average; None without a limit."""
    quotas = [*_values(read, "cpu.max")]
    old = [read(f"{_ROOT}/cpu/cpu.cfs_{name}_us").strip() for name in ("quota", "period")]
    pairs = [text.split() for text in (*quotas, " ".join(old))]
    shares = [int(pair[0]) / int(pair[1]) for pair in pairs if len(pair) == 2 and all(map(_is_limit, pair))]
    return min(shares, default=None)


def memory_bytes(read: Read = text_of) -> int | None:
    """How much memory all processes of the group may use together; None without a limit."""
    texts = [*_values(read, "memory.max"), read(f"{_ROOT}/memory/memory.limit_in_bytes")]
    limits = [int(text) for text in texts if _is_limit(text.strip())]
    return min(
        (limit for limit in limits if limit < 1 << 60), default=None
    )  # without one, version 1 has 2**63


def _is_limit(text: str) -> bool:
    return re.fullmatch(r"[1-9]\d{0,19}", text) is not None


def _values(read: Read, name: str) -> Iterator[str]:
    """The content of the file `name` of this process's group and of all groups around it, in version 2."""
    found = re.search(r"^0::(/.*)$", read("/proc/self/cgroup"), re.MULTILINE)
    group = PurePosixPath(found[1] if found else "/")
    for folder in (group, *group.parents):
        yield read(f"{_ROOT}{folder}/{name}")
