"""Reading of serialized messages field by field: anybody in the ROS domain may send one of any size."""

from __future__ import annotations

import struct

_HEADER_BYTES = 4
_BYTES_PER_LETTER = 4


class UnreadableError(ValueError):
    """The message is not one of its type."""


class SerializedMessage:
    """The fields of `content`, in their order; what is not read costs nothing.

    `content` is as rclpy gives it to a raw subscription: a header of four bytes, then the fields (CDR), each
    at a multiple of its size. Every method raises UnreadableError if the message ends too early.
    """

    def __init__(self, content: bytes) -> None:
        self._content = content
        self._order = ">" if content[1:2] == b"\0" else "<"
        self._at = _HEADER_BYTES

    def byte(self) -> int:
        return self._number("B", 1)

    def class_id(self) -> int:
        """An unsigned integer of 16 bits."""
        return self._number("H", 2)

    def count(self) -> int:
        """Number of elements of a sequence, or of bytes of a string."""
        return self._number("I", 4)

    def time_s(self) -> float:
        """A builtin_interfaces/Time in seconds."""
        return self._number("i", 4) + self._number("I", 4) * 1e-9

    def text(self, limit: int) -> str:
        """A string; of one much longer than `limit` characters, the beginning and the number of bytes."""
        length = max(self.count() - 1, 0)  # a NUL ends it
        start, self._at = self._at, self._at + length + 1
        if self._at > len(self._content):
            raise UnreadableError("a string ends after the message")
        read = min(length, _BYTES_PER_LETTER * limit)
        text = self._content[start : start + read].decode("utf-8", "replace")
        if read == length:
            return text
        end = f"... ({length} bytes)"
        return text[: max(0, limit - len(end))] + end

    def _number(self, form: str, size: int) -> int:
        self._at += (_HEADER_BYTES - self._at) % size
        try:
            (number,) = struct.unpack_from(self._order + form, self._content, self._at)
        except struct.error:
            raise UnreadableError("a number lies after the end of the message") from None
        self._at += size
        return int(number)
