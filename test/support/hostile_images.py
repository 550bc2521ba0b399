"""Compressed images that make a decoder take another size, much memory or much time; all are small files."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping

from support import jpeg_builder as jpeg
from support import png_builder as png
from yolov5_lifecycle.images.jpeg_structure import MAX_SCANNED_PX, MAX_SCANS, MAX_SEGMENTS
from yolov5_lifecycle.images.png_structure import MAX_CHUNKS

_SMALL, _HUGE = (48, 64), (32760, 32760)
_HUGE_JPEG = jpeg.image(*_HUGE)


def _hidden_behind(marker: bytes) -> bytes:
    """Who takes the marker's next two bytes for a length finds a small frame inside an APP0 segment."""
    length = 0xFFE0
    payload = bytearray(65533)
    small = jpeg.frame(*_SMALL)
    payload[length - 4 : length - 4 + len(small)] = small
    return jpeg.SOI + marker + jpeg.segment(0xE0, bytes(payload)) + _HUGE_JPEG[2:]


HOSTILE_JPEGS = {
    "a large frame behind TEM": (_hidden_behind(b"\xff\x01"), "found marker FF01"),
    "a large frame behind a restart marker": (_hidden_behind(b"\xff\xd0"), "found marker FFD0"),
    "a large frame behind a stuffed zero": (jpeg.SOI + b"\xff\0\0\x04" + _HUGE_JPEG[2:], "found marker FF00"),
    "two starts": (jpeg.SOI + jpeg.image(*_SMALL), r"second start of image \(FFD8\)"),
    "two frames": (
        jpeg.opened(jpeg.frame(*_SMALL), jpeg.frame(*_HUGE)) + jpeg.closed(),
        "one frame header, found a second one",
    ),
    "a frame behind a scan": (
        jpeg.image(*_SMALL)[:-2] + jpeg.frame(*_HUGE) + jpeg.closed(),
        r"found a frame header of type SOF0 \(FFC0\) among them",
    ),
    "no frame": (jpeg.opened() + jpeg.closed(), "found a scan without one"),
    "an end without a scan": (jpeg.opened(jpeg.frame(*_SMALL)) + jpeg.EOI, "found the end of the image"),
    "a byte between segments": (
        jpeg.SOI + jpeg.tables() + b"\0" + jpeg.frame(*_SMALL) + jpeg.closed(),
        "JPEG marker at byte 126, found another byte",
    ),
    "an unknown marker among the scans": (
        jpeg.image(*_SMALL)[:-2] + b"\xff\x02" + jpeg.EOI,
        "found marker FF02 among them",
    ),
    "a segment longer than the file": (
        jpeg.SOI + b"\xff\xe0\xff\xff" + _HUGE_JPEG[2:],
        "marker FFE0 claims 65535 bytes at 4",
    ),
    "a scan longer than the file": (
        jpeg.opened(jpeg.frame(*_SMALL)) + b"\xff\xda\xff\xff",
        "claims 65535 by",
    ),
    "a lossless frame": (jpeg.image(*_SMALL, marker=0xC3), "found a frame header of type SOF3"),
    "arithmetic conditioning": (
        jpeg.opened(jpeg.segment(0xCC, b"\0\0"), jpeg.frame(*_SMALL)) + jpeg.closed(),
        "found marker FFCC",
    ),
    "12 bits": (jpeg.opened(jpeg.frame(*_SMALL, bits=12)) + jpeg.closed(), "of 8 bits, found 12"),
    "2 components": (jpeg.image(*_SMALL, components=2), "3 or 4 components, found 2"),
    "a height in DNL": (
        jpeg.image(0, 64)[:-2] + jpeg.segment(0xDC, b"\0\x30") + jpeg.EOI,
        "found 0 x 64",
    ),
    "too many pixels": (jpeg.image(16384, 16384), "this one claims 16384 x 16384"),
    "too many scans": (
        jpeg.progressive(*_SMALL, scans=MAX_SCANS + 1),
        f"this one has {MAX_SCANS + 1} of 48 x 64",
    ),
    "too many scanned pixels": (
        jpeg.progressive(4096, 4096, scans=MAX_SCANNED_PX // 4096**2 + 1),
        "this one has 17 of 4096 x 4096",
    ),
    "too many segments": (
        jpeg.opened(jpeg.segment(0xE1, b"") * MAX_SEGMENTS, jpeg.frame(*_SMALL)) + jpeg.closed(),
        "segments and fill bytes, this one has more",
    ),
    "too many fill bytes": (
        jpeg.opened(b"\xff" * MAX_SEGMENTS, jpeg.frame(*_SMALL)) + jpeg.closed(),
        "segments and fill bytes, this one has more",
    ),
    "too many segments behind a scan": (
        jpeg.image(*_SMALL)[:-2] + jpeg.segment(0xE1, b"") * MAX_SEGMENTS + jpeg.EOI,
        "segments and fill bytes, this one has more",
    ),
}
"""Bytes, and what the refusal says; by what is wrong with them."""

HOSTILE_PNGS = {
    "a long header": (
        png.SIGNATURE + png.chunk(b"IHDR", png.header(*_SMALL)[8:21] + b"\0") + png.image(*_SMALL)[33:],
        "begins with one IHDR of 13 bytes",
    ),
    "two headers": (png.image(*_SMALL, before=png.header(*_HUGE)), "begins with one IHDR of 13 bytes"),
    "a header behind a text": (
        png.SIGNATURE + png.chunk(b"tEXt", b"k\0") + png.image(*_SMALL)[8:],
        "begins with one IHDR of 13 bytes",
    ),
    "two palettes": (
        png.image(*_SMALL, before=png.chunk(b"PLTE", bytes(3)) * 2),
        "with one PLTE, found a second",
    ),
    "an unknown critical chunk": (
        png.image(*_SMALL, before=png.chunk(b"CgBI", bytes(4))),
        "unknown type b'CgBI'",
    ),
    "too many pixels": (png.SIGNATURE + png.header(16384, 16384) + png.image(1, 1)[33:], "16384 x 16384"),
    "too many chunks": (png.image(*_SMALL, before=png.chunk(b"tEXt") * MAX_CHUNKS), "65536 chunks, this one"),
    "a chunk longer than the file": (
        png.image(*_SMALL)[:33] + b"\xff\xff\xff\xff" + png.image(*_SMALL)[37:],
        "within a chunk",
    ),
    "no pixels": (png.SIGNATURE + png.header(*_SMALL) + png.chunk(b"IEND"), "without pixels"),
}
"""The same."""


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

FOREIGN_FILES = {
    "PNM": b"P6\n8192 8192\n255\n",
    "PFM": b"PF\n8192 8192\n-1.0\n",
    "HDR": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 8192 +X 8192\n",
    "GIF": b"GIF89a\0\x20\0\x20\xf0\0\0",
    "Sun raster": b"\x59\xa6\x6a\x95",
    "JPEG 2000": b"\0\0\0\x0cjP  \r\n\x87\n",
    "AVIF": b"\0\0\0\x1cftypavif",
    "OpenEXR": b"v/1\x01",
    "BigTIFF": b"II+\0\x08\0\0\0",
    "a video": b"RIFF0000AVI ",
}
"""Beginnings of files that OpenCV may decode, and whose cost nobody has counted."""
