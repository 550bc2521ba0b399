"""MCAP files, written record by record: legal ones of any layout, and others. https://mcap.dev/spec"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from zlib import crc32

import lz4.frame  # type: ignore[import-untyped]

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, STATISTICS, DATA_END = 1, 2, 3, 4, 5, 6, 0x0B, 0x0F


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(content: str) -> bytes:
    return struct.pack("<I", len(content.encode())) + content.encode()


def channel(
    number: int, topic: str, type_name: str, *, encoding: str = "cdr", has_schema: bool = True
) -> bytes:
    """A channel and before it its schema, which has the same number."""
    schema = struct.pack("<H", number) + text(type_name) + text("ros2msg") + text("")
    described = struct.pack("<HH", number, number) + text(topic) + text(encoding) + text("")
    return (record(SCHEMA, schema) if has_schema else b"") + record(CHANNEL, described)


def message(number: int, time_ns: int, data: bytes) -> bytes:
    return record(MESSAGE, struct.pack("<HIQQ", number, 0, time_ns, time_ns) + data)


def chunk(
    content: bytes, compression: str = "", *, claim: int | None = None, crc: int | None = None
) -> bytes:
    packed = lz4.frame.compress(content) if compression == "lz4" else content
    start = struct.pack(
        "<QQQI", 0, 0, len(content) if claim is None else claim, crc32(content) if crc is None else crc
    )
    return record(CHUNK, start + text(compression) + struct.pack("<Q", len(packed)) + packed)


def statistics(counts: Mapping[int, int]) -> bytes:
    pairs = b"".join(struct.pack("<HQ", *pair) for pair in counts.items())
    total = struct.pack("<QHIIIIQQ", sum(counts.values()), len(counts), len(counts), 0, 0, 0, 0, 0)
    return record(STATISTICS, total + struct.pack("<I", len(pairs)) + pairs)


def mcap(data: Sequence[bytes], summary: Sequence[bytes] = (), *, profile: str = "ros2") -> bytes:
    """A whole file with these records in its data section and its summary."""
    begun = MAGIC + record(HEADER, text(profile) + text("")) + b"".join(data) + record(DATA_END, bytes(4))
    start = len(begun) if summary else 0
    return begun + b"".join(summary) + record(FOOTER, struct.pack("<QQI", start, 0, 0)) + MAGIC
