"""Pickle operations, parsed without executing them."""

from __future__ import annotations

import io
import pickletools
from collections.abc import Iterator
from typing import NamedTuple

from yolov5_lifecycle.models.model import WeightsError

MAX_OPERATIONS = 1_000_000
"""yolov5n has a thirtieth of it, an x6 with its EMA and its optimizer a third."""

# Protocol 2 as torch.save writes it: the size in bytes of an argument, or of its length prefix.
_FIXED = {
    **dict.fromkeys(("PROTO", "BININT1", "BINGET", "BINPUT"), 1),
    **dict.fromkeys(("BININT", "LONG_BINGET", "LONG_BINPUT"), 4),
    **dict.fromkeys(
        ("STOP", "MARK", "NONE", "NEWFALSE", "NEWTRUE", "BINPERSID", "NEWOBJ", "REDUCE", "BUILD"), 0
    ),
    **dict.fromkeys(("TUPLE", "EMPTY_TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_LIST", "EMPTY_DICT"), 0),
    **dict.fromkeys(("APPEND", "APPENDS", "SETITEM", "SETITEMS"), 0),
    "BININT2": 2,
    "BINFLOAT": 8,
}
_LENGTH = {"BINUNICODE": 4, "SHORT_BINSTRING": 1, "LONG1": 1}
_NAMES = {ord(operation.code): operation.name for operation in pickletools.opcodes}


class Operation(NamedTuple):
    """A pickle operation; `number` is unsigned (memo index, protocol), `text` a string or "module.name"."""

    name: str
    number: int = 0
    text: str = ""


def operations(pickle: bytes) -> Iterator[Operation]:
    """Operations up to STOP; raises WeightsError if torch.save never writes one, or STOP is too far away.

    Replaces `pickletools.genops`, which interprets escapes in names although no unpickler does.
    """
    stream = io.BytesIO(pickle)
    for _ in range(MAX_OPERATIONS):
        operation = _operation(_exactly(stream, 1)[0], stream)
        yield operation
        if operation.name == "STOP":
            return
    raise WeightsError(f"its pickle has more than {MAX_OPERATIONS} operations")


def _operation(code: int, stream: io.BytesIO) -> Operation:
    name = _NAMES.get(code, f"the byte {code}")
    if name in _FIXED:
        argument = _exactly(stream, _FIXED[name])
        if name == "PROTO" and argument != b"\x02":
            raise WeightsError(f"its pickle is of protocol {argument[0]}; torch.save writes protocol 2")
        return Operation(name, int.from_bytes(argument, "little"))
    if name in _LENGTH:
        length = int.from_bytes(_exactly(stream, _LENGTH[name]), "little")
        return Operation(
            name, text=_decoded(_exactly(stream, length), "utf-8" if name == "BINUNICODE" else "latin1")
        )
    if name == "GLOBAL":
        return Operation(name, text=f"{_line(stream)}.{_line(stream)}")
    raise WeightsError(f"its pickle uses {name}, which torch never does: do not trust it")


def _exactly(stream: io.BytesIO, size: int) -> bytes:
    found = stream.read(size)
    if len(found) < size:
        raise WeightsError("its pickle is cut short")
    return found


def _line(stream: io.BytesIO) -> str:
    line = stream.readline()
    if not line.endswith(b"\n"):
        raise WeightsError("its pickle is cut short")
    return _decoded(line[:-1], "utf-8")


def _decoded(text: bytes, encoding: str) -> str:
    try:
        return text.decode(encoding, "surrogatepass")
    except UnicodeDecodeError:
        raise WeightsError("its pickle is damaged: it contains an invalid string") from None
