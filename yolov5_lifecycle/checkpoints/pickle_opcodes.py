"""Pickle operations, parsed without executing them."""

from __future__ import annotations

import io
import pickletools
import sys
from collections.abc import Iterator
from typing import NamedTuple

from yolov5_lifecycle.models.model import WeightsError

MAX_OPERATIONS = 1_000_000
"""yolov5n has a thirtieth of it, an x6 with its EMA and its optimizer a third."""
_MAX_PROTOCOL = 5
# Protocols 2 to 5 as torch.save writes them: the size in bytes of an argument, or of its length prefix.
_FIXED = {
    **dict.fromkeys(("PROTO", "BININT1", "BINGET", "BINPUT"), 1),
    **dict.fromkeys(("BININT", "LONG_BINGET", "LONG_BINPUT"), 4),
    **dict.fromkeys(
        ("STOP", "MARK", "NONE", "NEWFALSE", "NEWTRUE", "BINPERSID", "NEWOBJ", "REDUCE", "BUILD"), 0
    ),
    **dict.fromkeys(("TUPLE", "EMPTY_TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_LIST", "EMPTY_DICT"), 0),
    **dict.fromkeys(("APPEND", "APPENDS", "SETITEM", "SETITEMS"), 0),
    **dict.fromkeys(("MEMOIZE", "STACK_GLOBAL", "EMPTY_SET", "ADDITEMS"), 0),  # of protocol 4
    "BININT2": 2,
    "BINFLOAT": 8,
    "FRAME": 8,
}
_TEXTS = {"BINUNICODE": 4, "SHORT_BINUNICODE": 1, "SHORT_BINSTRING": 1, "LONG1": 1}
_BYTES = {"BINBYTES": 4, "SHORT_BINBYTES": 1, "BYTEARRAY8": 8}
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
        number = int.from_bytes(_exactly(stream, _FIXED[name]), "little")
        _check_argument(name, number, stream)
        return Operation(name, number)
    if name in _TEXTS:
        encoding = "utf-8" if name.endswith("BINUNICODE") else "latin1"
        return Operation(name, text=_decoded(_counted(stream, _TEXTS[name]), encoding))
    if name in _BYTES:
        return Operation(name, number=len(_counted(stream, _BYTES[name])))
    if name == "GLOBAL":
        return Operation(name, text=f"{_line(stream)}.{_line(stream)}")
    raise WeightsError(f"its pickle uses {name}, which torch.save never does: do not trust it")


def _check_argument(name: str, number: int, stream: io.BytesIO) -> None:
    if name == "PROTO" and not 2 <= number <= _MAX_PROTOCOL:
        raise WeightsError(
            f"its pickle is of protocol {number}, expected 2 to {_MAX_PROTOCOL}: save the model again with "
            "torch.save(..., pickle_protocol=2)"
        )
    # A frame is a size to read ahead, nothing else: its operations follow as without it.
    if name == "FRAME" and number > len(stream.getbuffer()) - stream.tell():
        raise WeightsError("its pickle is cut short")


def _counted(stream: io.BytesIO, prefix_bytes: int) -> bytes:
    """The bytes of an argument that begins with its length."""
    return _exactly(stream, int.from_bytes(_exactly(stream, prefix_bytes), "little"))


def _exactly(stream: io.BytesIO, size: int) -> bytes:
    found = stream.read(min(size, sys.maxsize))
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
