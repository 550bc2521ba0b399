"""Compressed images that make a decoder take another size, much memory or much time; all are small files."""

from __future__ import annotations

from support import jpeg_builder as jpeg
from support import png_builder as png
from yolov5_lifecycle.images.compressed import MAX_CHUNKS, MAX_SCANNED_PX, MAX_SCANS, MAX_SEGMENTS
from yolov5_lifecycle.process.environment import MAX_COMPRESSED_PX

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
    "a large frame behind a restart marker": (_hidden_behind(b"\xff\xd0"), "32760 x 32760"),
    "a large frame behind a stuffed zero": (
        jpeg.SOI + b"\xff\0\0\x04" + _HUGE_JPEG[2:],
        "32760 x 32760",
    ),
    "two starts": (jpeg.SOI + jpeg.image(*_SMALL), "found marker FFD8 at byte 2"),
    "two frames": (
        jpeg.opened(jpeg.frame(*_SMALL), jpeg.frame(*_HUGE)) + jpeg.closed(),
        "one frame header, before its scans, found marker FFC0",
    ),
    "a frame behind a scan": (
        jpeg.image(*_SMALL)[:-2] + jpeg.frame(*_HUGE) + jpeg.closed(),
        "found marker FFC0",
    ),
    "no frame": (jpeg.opened() + jpeg.closed(), "found marker FFDA"),
    "an end without a scan": (jpeg.opened(jpeg.frame(*_SMALL)) + jpeg.EOI, "without a scan"),
    "an unknown marker among the scans": (
        jpeg.image(*_SMALL)[:-2] + b"\xff\x02" + jpeg.EOI,
        "found marker FF02",
    ),
    "a segment longer than the file": (
        jpeg.SOI + b"\xff\xe0\xff\xff" + _HUGE_JPEG[2:],
        "marker FFE0 claims 65535 bytes at 4",
    ),
    "a scan longer than the file": (
        jpeg.opened(jpeg.frame(*_SMALL)) + b"\xff\xda\xff\xff",
        "claims 65535 by",
    ),
    "a lossless frame": (jpeg.image(*_SMALL, marker=0xC3), "found marker FFC3.*Save it as a baseline JPEG"),
    "arithmetic conditioning": (
        jpeg.opened(jpeg.segment(0xCC, b"\0\0"), jpeg.frame(*_SMALL)) + jpeg.closed(),
        "found marker FFCC",
    ),
    "12 bits": (
        jpeg.opened(jpeg.frame(*_SMALL, bits=12)) + jpeg.closed(),
        "of 8 bits and .*, found 12 bits",
    ),
    "2 components": (jpeg.image(*_SMALL, components=2), "found 8 bits and 2 components"),
    "a height in DNL": (
        jpeg.image(0, 64)[:-2] + jpeg.segment(0xDC, b"\0\x30") + jpeg.EOI,
        "found 0 x 64",
    ),
    "too many pixels": (jpeg.image(8193, 8192), f"{MAX_COMPRESSED_PX} pixels, this one claims 8193 x 8192"),
    "too many rows": (jpeg.image(65535, 1), "found 65535 x 1"),
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
        "1000 segments, this one has more",
    ),
}
"""Bytes, and what the refusal says; by what is wrong with them."""

HOSTILE_PNGS = {
    "a long header": (
        png.SIGNATURE + png.chunk(b"IHDR", png.header(*_SMALL)[8:21] + b"\0") + png.image(*_SMALL)[33:],
        "begins with an IHDR of 13 bytes",
    ),
    "too many pixels": (png.SIGNATURE + png.header(8193, 8192) + png.image(1, 1)[33:], "claims 8193 x 8192"),
    "no chunk": (png.SIGNATURE, "found 8 bytes that end within a chunk"),
    "no rows": (png.image(0, 1), "found 0 x 1"),
    "too many chunks": (png.image(*_SMALL, before=png.chunk(b"tEXt") * MAX_CHUNKS), "65536 chunks, this one"),
    "a chunk longer than the file": (
        png.image(*_SMALL)[:33] + b"\xff\xff\xff\xff" + png.image(*_SMALL)[37:],
        "within a chunk",
    ),
    "no pixels": (png.SIGNATURE + png.header(*_SMALL) + png.chunk(b"IEND"), "without pixels"),
}
"""The same."""

FOREIGN_FILES = {
    "PNM": b"P6\n8192 8192\n255\n",
    "GIF": b"GIF89a\0\x20\0\x20\xf0\0\0",
    "TIFF": b"II*\0\x08\0\0\0",
    "a video": b"RIFF0000AVI ",
}
"""Beginnings of files that OpenCV may decode, and whose cost nobody has counted."""
