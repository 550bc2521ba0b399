"""Protocol buffer messages, field by field, without a schema.

The package onnx is an extra, and the parser of the package protobuf builds an object for every two bytes of a
hostile file before anything can be counted.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Union

from yolov5_lifecycle.models.model import WeightsError

MAX_FIELDS = 500_000
"""Fields and packed integers in all messages of a file; the export of YOLOv5x6 has about 40,000."""
MAX_TEXT_BYTES = 1_000
"""Of the names of operations, values and arrays."""
Value = Union[int, memoryview]  # noqa: UP007 - the new form cannot be evaluated by 3.10
"""An integer, or the bytes of anything else: a text, a nested message, packed numbers, a float."""
_FIXED_BYTES = {1: 8, 5: 4}
_MAX_VARINT_BYTES = 10


class ProtobufReader:
    """Reads messages of one file, at most `MAX_FIELDS` fields and packed integers altogether."""

    def __init__(self) -> None:
        self._left = MAX_FIELDS

    def fields(self, message: memoryview) -> Iterator[tuple[int, Value]]:
        """Number and value of each field; no bytes are copied. Raises WeightsError."""
        place = 0
        while place < len(message):
            self._count()
            key, place = _varint(message, place)
            number, kind = key >> 3, key & 7
            if kind == 0:
                value, place = _varint(message, place)
                yield number, value
                continue
            if kind == 2:
                length, place = _varint(message, place)
            elif kind in _FIXED_BYTES:
                length = _FIXED_BYTES[kind]
            else:
                raise damaged(f"a field of kind {kind}")
            if length > len(message) - place:
                raise damaged(f"a field claims {length} bytes, {len(message) - place} are left")
            yield number, message[place : place + length]
            place += length

    def integers(self, value: Value) -> Iterator[int]:
        """The signed integers of a repeated field: one, or several that are packed."""
        if isinstance(value, int):
            yield _signed(value)
            return
        place = 0
        while place < len(value):
            self._count()
            number, place = _varint(value, place)
            yield _signed(number)

    def _count(self) -> None:
        self._left -= 1
        if self._left < 0:
            raise WeightsError(f"the file has more than {MAX_FIELDS} fields: no export of YOLOv5 has")


def damaged(found: str) -> WeightsError:
    """The refusal of a file that is not a message of the expected kind."""
    return WeightsError(f"the file is damaged, cut short or no ONNX model ({found}): copy or export it again")


def text(value: Value, *, limit_bytes: int = MAX_TEXT_BYTES) -> str:
    """The text of a field; raises WeightsError if it has none, or a longer one."""
    content = nested(value)
    if len(content) > limit_bytes:
        raise damaged(f"a text of {len(content)} bytes, at most {limit_bytes} are read")
    try:
        return str(content, "utf-8")
    except UnicodeDecodeError:
        raise damaged("a text that is not UTF-8") from None


def nested(value: Value) -> memoryview:
    """The bytes of a nested message; raises WeightsError."""
    if isinstance(value, int):
        raise damaged("a number where bytes are expected")
    return value


def integer(value: Value) -> int:
    """The signed integer of a field; raises WeightsError."""
    if not isinstance(value, int):
        raise damaged("bytes where a number is expected")
    return _signed(value)


def _signed(number: int) -> int:
    return number - (1 << 64) if number >> 63 else number


def _varint(data: memoryview, place: int) -> tuple[int, int]:
    """An integer of up to 64 bits, and the place after it."""
    number = 0
    for count, byte in enumerate(data[place : place + _MAX_VARINT_BYTES]):
        number |= (byte & 127) << (7 * count)
        if byte < 128:
            if number >> 64:
                break
            return number, place + count + 1
    raise damaged("an integer without end")
