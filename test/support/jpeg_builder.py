"""JPEG files put together segment by segment, plain ones and ones that no encoder writes."""

from __future__ import annotations

import struct
from collections.abc import Sequence

SOI, EOI = b"\xff\xd8", b"\xff\xd9"
BASELINE, PROGRESSIVE = 0xC0, 0xC2
EVERY_COEFFICIENT, FIRST_COEFFICIENT = (0, 63, 0x00), (0, 0, 0x00)
"""First and last coefficient of a scan, and which bits of them."""
_CATEGORIES = range(12)


def segment(marker: int, payload: bytes) -> bytes:
    return bytes([0xFF, marker]) + struct.pack(">H", len(payload) + 2) + payload


def frame(height: int, width: int, *, marker: int = BASELINE, components: int = 3, bits: int = 8) -> bytes:
    rows = b"".join(bytes([number + 1, 0x11, 0]) for number in range(components))
    return segment(marker, struct.pack(">BHHB", bits, height, width, components) + rows)


def scan(components: Sequence[int], coefficients: tuple[int, int, int], data: bytes = b"\0") -> bytes:
    """A scan of the components with these numbers, from 1 on, with its coded data."""
    rows = b"".join(bytes([number, 0]) for number in components)
    return segment(0xDA, bytes([len(components)]) + rows + bytes(coefficients)) + data


def tables() -> bytes:
    """A quantization table that makes the first coefficient the mean of its block, and two Huffman tables.

    A difference of the first coefficients has its category, in 4 bits, before its own bits; a single bit 0
    ends the block.
    """
    quantization = segment(0xDB, b"\0" + bytes([8]) * 64)
    differences = segment(0xC4, b"\x00" + bytes([0, 0, 0, 12, *[0] * 12]) + bytes(_CATEGORIES))
    others = segment(0xC4, b"\x10" + bytes([1, *[0] * 15]) + b"\0")
    return quantization + differences + others


def image(height: int, width: int, *, components: int = 3, marker: int = BASELINE) -> bytes:
    """A whole file without data: every pixel is grey."""
    return opened(frame(height, width, components=components, marker=marker)) + closed(components, marker)


def opened(*segments: bytes) -> bytes:
    """The beginning of a file, with tables, up to the scans."""
    return SOI + tables() + b"".join(segments)


def closed(components: int = 3, marker: int = BASELINE) -> bytes:
    """One scan without data, and the end."""
    coefficients = FIRST_COEFFICIENT if marker == PROGRESSIVE else EVERY_COEFFICIENT
    return scan(range(1, components + 1), coefficients) + EOI


def progressive(height: int, width: int, scans: int) -> bytes:
    """A grey progressive file with so many scans."""
    refinement = scan([1], (0, 0, 0x10))
    start = opened(frame(height, width, marker=PROGRESSIVE, components=1))
    return start + scan([1], FIRST_COEFFICIENT) + refinement * (scans - 1) + EOI


def blocks(values: Sequence[Sequence[int]], *, before_scan: bytes = b"") -> bytes:
    """A file of one row of blocks of 8 x 8 pixels, each of one colour.

    `values` are (blocks, components) in [0, 255].
    """
    components = len(values[0])
    before, bits = [128] * components, ""
    for block in values:
        for index, value in enumerate(block):
            bits += _coded(value - before[index]) + "0"
            before[index] = value
    bits += "1" * (-len(bits) % 8)
    data = int(bits, 2).to_bytes(len(bits) // 8, "big").replace(b"\xff", b"\xff\0")
    start = opened(frame(8, 8 * len(values), components=components), before_scan)
    return start + scan(range(1, components + 1), EVERY_COEFFICIENT, data) + EOI


def _coded(difference: int) -> str:
    category = abs(difference).bit_length()
    value = difference if difference >= 0 else difference + (1 << category) - 1
    return f"{category:04b}" + (f"{value:0{category}b}" if category else "")


def with_orientation(data: bytes, orientation: int) -> bytes:
    """That JPEG with EXIF data that ask for a rotation: 6 is a quarter to the right."""
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 1) + entry + bytes(4)
    return data[:2] + segment(0xE1, exif) + data[2:]
