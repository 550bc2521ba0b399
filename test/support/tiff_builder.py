"""TIFF files of one directory, with any values in their tags."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping

_ROW = zlib.compress(bytes(64 * 3))


def tiff(changed: Mapping[int, object] | None = None, *, order: str = "<", end: int | None = None) -> bytes:
    """A black image, 2 x 64, of two strips; `changed` tags have other values, None leaves one out."""
    data = 1000
    tags: dict[int, object] = {256: 64, 257: 2, 258: (8, 8, 8), 259: 8, 262: 2, 277: 3, 278: 1, 284: 1}
    tags |= {273: (data, data), 279: (len(_ROW),) * 2, **(changed or {})}
    entries, values = b"", b""
    present = {tag: value for tag, value in tags.items() if value is not None}
    for tag in sorted(present):
        found = present[tag]
        numbers = found if isinstance(found, tuple) else (found,)
        field = struct.pack(f"{order}{len(numbers)}I", *numbers)
        if len(numbers) > 1:
            values, field = values + field, struct.pack(f"{order}I", 400 + len(values))
        entries += struct.pack(f"{order}HHI", tag, 4, len(numbers)) + field
    head = struct.pack(f"{order}2sHIH", b"II" if order == "<" else b"MM", 42, 8, len(present))
    file = (head + entries).ljust(400, b"\0") + values
    return (file.ljust(data, b"\0") + _ROW)[:end]


HOSTILE_TIFFS = {
    "too many pixels": (tiff({256: 16384, 257: 16384}), "at most 67108864 pixels, found 268435456"),
    "too wide": (tiff({256: 1 << 20}), "found 2 x 1048576"),
    "no width": (tiff({256: None}), "found 2 x 0"),
    "a tile larger than all images": (tiff({322: 16384, 323: 16384}), "found 268435456 in its parts"),
    "many tiles for few pixels": (
        tiff({257: 16384, 322: 1 << 20, 323: 16}),
        "found 17179869184 in its parts",
    ),
    "strips that have the same megabytes": (
        tiff({279: (1000, 1000)}),
        "parts of a TIFF of 1012 bytes together",
    ),
    "strips of unknown length": (tiff({279: (0, 10)}), "bytes of each part of a TIFF, found 0"),
    "no lengths": (tiff({279: None}), "together, found another sum"),
    "a JPEG in it": (tiff({259: 7}), "none, LZW, Deflate, PackBits in a TIFF, found number 7"),
    "values behind the end": (tiff(end=400), "a complete TIFF, found 400 bytes"),
    "a directory behind the end": (tiff(end=8), "a complete TIFF, found 8 bytes"),
    "a tag twice": (
        tiff().replace(b"\x01\x01\x04\0", b"\0\x01\x04\0", 1),
        "tags of a TIFF in order, each once",
    ),
}
"""Bytes, and what the refusal says; by what is wrong with them."""
