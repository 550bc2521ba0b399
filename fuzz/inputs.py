"""What the checks need: fields of fuzzed bytes, files with them, refusals as the right answer."""

from __future__ import annotations

import atexit
import shutil
import struct
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

Taken = TypeVar("Taken")


def taken(take: Callable[[], Taken], refusal: type[Exception]) -> Taken | None:
    """The result of `take`, None if it raises the `refusal`, which must be one line; others propagate."""
    try:
        return take()
    except refusal as error:
        assert str(error).isprintable(), repr(error)
        return None


class Fields:
    """Reads `data` from the start; bytes missing at the end are zeros."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._place = 0

    @property
    def left(self) -> int:
        """Number of bytes that have not been read."""
        return max(len(self._data) - self._place, 0)

    def take(self, count: int) -> bytes:
        """The next `count` bytes."""
        found = self._data[self._place : self._place + count]
        self._place += count
        return found.ljust(count, b"\0")

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """The values of the next structure."""
        return layout.unpack(self.take(layout.size))


@cache
def folder() -> Path:
    """Removed at the end."""
    made = Path(tempfile.mkdtemp()).resolve()
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def written(name: str, data: bytes) -> Path:
    """The file of this name in `folder()`, with `data`."""
    path = folder() / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path
