"""How much structure an ONNX file has, counted before the package onnx makes an object of each part.

That parser makes about a hundred bytes of every two bytes of a hostile file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Union

from yolov5_lifecycle.models.model import WeightsError

MAX_FIELDS = 200_000
"""Fields of all messages on the way to the numbers; the export of YOLOv5x6 has about 40,000."""
MAX_STRUCTURE_BYTES = 4 << 20
"""All of a file but its raw numbers; the export of YOLOv5x6 has 0.3 MB."""
Value = Union[int, memoryview]  # noqa: UP007 - the new form cannot be evaluated by 3.10
_Places = Mapping[int, "_Places | None"]
_NUMBERS: _Places = {7: {5: {9: None}, 1: {5: {5: {9: None}}}}}
"""Field numbers on the way to raw numbers: graph, array or graph, node, attribute, array; None is the end."""
_FIXED_BYTES = {1: 8, 5: 4}
_MAX_VARINT_BYTES = 10


def check_structure(data: bytes) -> None:
    """Raise WeightsError if the file is no protocol buffer message or has more structure than an export."""
    structure = _Reader().bytes_without_numbers(memoryview(data), _NUMBERS)
    if structure > MAX_STRUCTURE_BYTES:
        raise WeightsError(
            f"the file has {structure:,} bytes besides the raw numbers of its arrays, at most "
            f"{MAX_STRUCTURE_BYTES:,} are read: export the model again"
        )


class _Reader:
    """Reads messages of one file without a schema, at most `MAX_FIELDS` fields altogether."""

    def __init__(self) -> None:
        self._left = MAX_FIELDS

    def bytes_without_numbers(self, message: memoryview, places: _Places) -> int:
        """The length of `message` without the raw numbers, to which `places` lead."""
        rest = len(message)
        for number, value in self._fields(message):
            if number in places and isinstance(value, memoryview):
                below = places[number]
                rest -= len(value)
                rest += 0 if below is None else self.bytes_without_numbers(value, below)
        return rest

    def _fields(self, message: memoryview) -> Iterator[tuple[int, Value]]:
        """Number and value of each field; no bytes are copied. Raises WeightsError."""
        place = 0
        while place < len(message):
            self._left -= 1
            if self._left < 0:
                raise WeightsError(f"the file has more than {MAX_FIELDS:,} fields: no export of YOLO has")
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


def damaged(found: str) -> WeightsError:
    """The refusal of a file that is not a message of the expected kind."""
    return WeightsError(f"the file is damaged, cut short or no ONNX model ({found}): copy or export it again")


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
