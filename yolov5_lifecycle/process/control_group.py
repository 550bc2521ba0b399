"""Limits that a container, systemd or a batch system sets for its processes: Linux control groups."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath

Read = Callable[[str], str]
"""The text of a file of the machine; "" if it cannot be read."""


def _text_of(name: str) -> str:
    try:
        return Path(name).read_text(encoding="ascii")
    except (OSError, ValueError):
        return ""


def cores(read: Read = _text_of) -> float | None:
    """How many processors this process may use on average; None without a limit."""
    limits = (text.split() for text in _limits(read, "cpu.max"))
    return min((int(quota_us) / int(period_us) for quota_us, period_us in limits), default=None)


def memory_bytes(read: Read = _text_of) -> int | None:
    """How much memory all processes of the group may use together; None without a limit."""
    return min(map(int, _limits(read, "memory.max")), default=None)


def _limits(read: Read, name: str) -> Iterator[str]:
    """The file `name` of this process's group and of all groups around it, in version 2, where it limits."""
    found = re.search(r"^0::(/.*)$", read("/proc/self/cgroup"), re.MULTILINE)
    group = PurePosixPath(found[1] if found else "/")
    for folder in (group, *group.parents):
        text = read(f"/sys/fs/cgroup{folder}/{name}")
        if text and not text.startswith("max"):
            yield text
