"""Pickles and archives put together by hand, as no honest program writes them."""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Mapping, Sequence

START = b"\x80\x02"
START_4, START_5 = b"\x80\x04", b"\x80\x05"
EMPTY_DICT, EMPTY_LIST, EMPTY_TUPLE = b"}", b"]", b")"
MARK, TUPLE, APPEND, SETITEM, BUILD, NEWOBJ, REDUCE, PERSID, STOP = (
    b"(", b"t", b"a", b"s", b"b", b"\x81", b"R", b"Q", b".",
)  # fmt: skip
EMPTY_SET, ADDITEMS, STACK_GLOBAL, MEMOIZE = b"\x8f", b"\x90", b"\x93", b"\x94"
"""Of protocol 4."""


def name(module: str, attribute: str) -> bytes:
    return f"c{module}\n{attribute}\n".encode()


def text(value: str) -> bytes:
    encoded = value.encode()
    return b"X" + struct.pack("<I", len(encoded)) + encoded


def short_text(value: str) -> bytes:
    """As protocol 4 writes it."""
    encoded = value.encode()
    return b"\x8c" + bytes([len(encoded)]) + encoded


def stacked_name(module: str, attribute: str) -> bytes:
    """A name as protocol 4 writes it."""
    return short_text(module) + short_text(attribute) + STACK_GLOBAL


def frame(content: bytes, claimed: int | None = None) -> bytes:
    return b"\x95" + struct.pack("<Q", len(content) if claimed is None else claimed) + content


def byte_array(content: bytes, claimed: int | None = None) -> bytes:
    return b"\x96" + struct.pack("<Q", len(content) if claimed is None else claimed) + content


def short_bytes(content: bytes) -> bytes:
    return b"C" + bytes([len(content)]) + content


def number(value: int) -> bytes:
    size = (value.bit_length() + 8) // 8
    return b"\x8a" + bytes([size]) + value.to_bytes(size, "little", signed=True)


def put(index: int) -> bytes:
    return b"r" + struct.pack("<I", index)


def get(index: int) -> bytes:
    return b"j" + struct.pack("<I", index)


def items(*values: bytes) -> bytes:
    """A tuple."""
    return MARK + b"".join(values) + TUPLE


def call(function: bytes, *arguments: bytes) -> bytes:
    return function + items(*arguments) + REDUCE


def mapping(entries: Mapping[str, bytes]) -> bytes:
    return EMPTY_DICT + b"".join(text(key) + value + SETITEM for key, value in entries.items())


def instance(module: str, cls: str, state: Mapping[str, bytes]) -> bytes:
    return name(module, cls) + EMPTY_TUPLE + NEWOBJ + mapping(state) + BUILD


def storage(numel: int | bytes = 4, *, kind: str = "FloatStorage", key: str = "0") -> bytes:
    count = number(numel) if isinstance(numel, int) else numel
    return items(text("storage"), name("torch", kind), text(key), text("cpu"), count) + PERSID


def tensor(
    size: Sequence[int] = (4,), stride: Sequence[int] = (1,), *, offset: int = 0, stored: bytes = b""
) -> bytes:
    return call(
        name("torch._utils", "_rebuild_tensor_v2"),
        stored or storage(),
        number(offset),
        items(*map(number, size)),
        items(*map(number, stride)),
        b"\x89",
        call(name("collections", "OrderedDict")),
    )


def model(parameter: bytes) -> bytes:
    """The value of a checkpoint whose model has one parameter."""
    group = {"_parameters": mapping({"weight": parameter})}
    return mapping({"model": instance("models.yolo", "Model", group)})


def archive(
    value: bytes,
    *,
    storages: Sequence[bytes] = (bytes(16),),
    more: Sequence[tuple[str, bytes]] = (),
    compression: int = zipfile.ZIP_STORED,
    start: bytes = START,
) -> bytes:
    """A checkpoint whose data.pkl leaves `value` on the stack."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as zipped:
        zipped.writestr("archive/data.pkl", start + value + STOP)
        zipped.writestr("archive/byteorder", "little")
        zipped.writestr("archive/version", "3\n")
        for index, content in enumerate(storages):
            zipped.writestr(f"archive/data/{index}", content)
        for path, content in more:
            zipped.writestr(path, content)
    return file.getvalue()
