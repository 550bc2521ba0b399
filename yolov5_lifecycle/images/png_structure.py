"""PNG chunk parser that strips chunks not needed to decode the pixels.

Chunks and their names: https://www.w3.org/TR/png-3/.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ImageError

MAX_CHUNKS = 1 << 16
"""Maximum number of chunks. Encoders split the pixels into chunks of at least 8 KiB."""

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHUNK = struct.Struct(">I4s")  # length of its data, name; the data and 4 bytes of checksum follow
_AROUND_DATA = _CHUNK.size + 4
_HEADER_BYTES = 13
_COLOURED = 3  # bits of the colour type: a palette, colours
_ONCE = {b"IHDR", b"PLTE", b"tRNS", b"eXIf"}
_USED = _ONCE | {b"IDAT", b"IEND"}


@dataclass(frozen=True)
class PngStructure:
    """Height and width in pixels, and the file (M,) reduced to the chunks needed to decode it."""

    size_hw: tuple[int, int]
    grey_bits: int | None
    """Per value; None if the file has colours."""
    pixels_alone: NDArray[np.uint8]


def is_png(buffer: NDArray[np.uint8]) -> bool:
    """Whether the bytes (N,) start with the PNG signature."""
    return buffer[: len(_SIGNATURE)].tobytes() == _SIGNATURE


def png_structure(buffer: NDArray[np.uint8]) -> PngStructure:
    """The structure of the PNG file (N,), parsed without decoding.

    Text, colour profiles and animation are stripped: libpng would decompress up to 8 MB of each, a thousand
    times. Data after IEND is stripped, too. The file is a view of `buffer` if contiguous.

    Raises ImageError when a chunk extends beyond the file, when a critical chunk is unknown, duplicated or
    misplaced, and for more than MAX_CHUNKS.
    """
    data, position = buffer.data, len(_SIGNATURE)
    kept, found = [slice(0, position)], set[bytes]()
    for _ in range(MAX_CHUNKS):
        name, end = _chunk(data, position)
        _check_chunk(name, found, end - position - _AROUND_DATA)
        if name in _USED:
            _keep(kept, position, end)
        found.add(name)
        position = end
        if name == b"IEND":
            break
    else:
        raise ImageError(f"A PNG may have {MAX_CHUNKS} chunks, this one has more.")
    if b"IDAT" not in found:
        raise ImageError(f"Expected a complete PNG, found {len(data)} bytes without pixels (IDAT).")
    width, height, bits, colour = struct.unpack_from(">IIBB", data, len(_SIGNATURE) + _CHUNK.size)
    return PngStructure((height, width), None if colour & _COLOURED else bits, _joined(buffer, kept))


def _chunk(data: memoryview, position: int) -> tuple[bytes, int]:
    """Name and end of the chunk at `position`."""
    if position + _AROUND_DATA <= len(data):
        length, name = _CHUNK.unpack_from(data, position)
        end = position + _AROUND_DATA + length
        if end <= len(data):
            return name, end
    raise ImageError(f"Expected a complete PNG, found {len(data)} bytes that end within a chunk.")


def _check_chunk(name: bytes, found: set[bytes], size: int) -> None:
    if (name == b"IHDR") == bool(found) or (name == b"IHDR" and size != _HEADER_BYTES):
        raise ImageError(f"Expected a PNG that begins with one IHDR of {_HEADER_BYTES} bytes, found another.")
    if name in found & _ONCE:
        raise ImageError(f"Expected a PNG with one {name.decode()}, found a second one.")
    is_critical = not name[0] & 0x20
    if is_critical and name not in _USED:
        raise ImageError(f"Expected a plain PNG, found a chunk of the unknown type {name!r}.")


def _keep(kept: list[slice], start: int, end: int) -> None:
    """Append the slice, merged into the last one when contiguous."""
    if kept[-1].stop == start:
        kept[-1] = slice(kept[-1].start, end)
    else:
        kept.append(slice(start, end))


def _joined(buffer: NDArray[np.uint8], kept: list[slice]) -> NDArray[np.uint8]:
    if len(kept) == 1:
        return buffer[kept[0]]
    return np.concatenate([buffer[stretch] for stretch in kept])
