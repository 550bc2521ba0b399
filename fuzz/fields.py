"""Fields read from fuzzed bytes."""

from __future__ import annotations

import struct
from typing import Any


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
        taken = self._data[self._place : self._place + count]
        self._place += count
        return taken.ljust(count, b"\0")

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """The values of the next structure."""
        return layout.unpack(self.take(layout.size))
