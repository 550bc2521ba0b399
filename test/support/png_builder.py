"""PNG files put together chunk by chunk."""

from __future__ import annotations

import struct
import zlib

SIGNATURE = b"\x89PNG\r\n\x1a\n"


def chunk(name: bytes, data: bytes = b"") -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def header(height: int, width: int) -> bytes:
    """Of an image of 8 bits in colour."""
    return chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))


def image(height: int, width: int, *, before: bytes = b"", after: bytes = b"") -> bytes:
    """A whole black file, with more chunks before or after the data of its pixels."""
    pixels = chunk(b"IDAT", zlib.compress(bytes(height * (1 + 3 * width))))
    return SIGNATURE + header(height, width) + before + pixels + after + chunk(b"IEND")
