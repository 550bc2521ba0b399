"""Compressed images that make a decoder take another size, much memory or much time; all are small files."""

from __future__ import annotations

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


def _too_many_scans() -> bytes:
    return jpeg.progressive(*_SMALL, scans=MAX_SCANS + 1)


def _too_many_scanned_pixels() -> bytes:
    side = 4096
    return jpeg.progressive(side, side, scans=MAX_SCANNED_PX // side**2 + 1)


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
    "an unknown marker": (jpeg.SOI + b"\xff\x02" + _HUGE_JPEG[2:], "found marker FF02"),
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
    "a hierarchical frame": (jpeg.image(*_SMALL, marker=0xC5), "found a frame header of type SOF5"),
    "an arithmetic frame": (jpeg.image(*_SMALL, marker=0xC9), "found a frame header of type SOF9"),
    "arithmetic conditioning": (
        jpeg.opened(jpeg.segment(0xCC, b"\0\0"), jpeg.frame(*_SMALL)) + jpeg.closed(),
        "found marker FFCC",
    ),
    "12 bits": (jpeg.opened(jpeg.frame(*_SMALL, bits=12)) + jpeg.closed(), "of 8 bits, found 12"),
    "2 components": (jpeg.image(*_SMALL, components=2), "3 or 4 components, found 2"),
    "no component": (jpeg.opened(jpeg.frame(*_SMALL, components=0)) + jpeg.closed(), "components, found 0"),
    "a height in DNL": (
        jpeg.image(0, 64)[:-2] + jpeg.segment(0xDC, b"\0\x30") + jpeg.EOI,
        "found 0 x 64",
    ),
    "too many pixels": (jpeg.image(16384, 16384), "this one claims 16384 x 16384"),
    "too many scans": (_too_many_scans(), f"this one has {MAX_SCANS + 1} of 48 x 64"),
    "too many scanned pixels": (_too_many_scanned_pixels(), "this one has 17 of 4096 x 4096"),
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
    "no pixels": (png.SIGNATURE + png.header(*_SMALL) + png.chunk(b"IEND"), "without pixels"),
}
"""The same."""
