"""What decoding a TIFF file costs, by its first directory: https://www.itu.int/itudoc/itu-t/com16/tiff-fx/docs/tiff6.pdf.

libtiff decodes each part of an image as often as the directory names it, with all bytes that it claims, and
whole where only a corner of it is in the image.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ImageError, check_size

_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_WIDTH, _HEIGHT, _COMPRESSION, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 259, 322, 323
_PART_BYTES = (279, 325)  # of strips, of tiles
_COMPRESSIONS = {1: "none", 5: "LZW", 8: "Deflate", 32773: "PackBits", 32946: "Deflate"}
"""The others hold images of other formats, which could claim anything."""
_VALUE_BYTES = {3: 2, 4: 4}
_ENTRY = (("tag", 2), ("kind", 2), ("length", 4), ("value", 4))
_Directory = dict[int, NDArray[Any]]


def is_tiff(buffer: NDArray[np.uint8]) -> bool:
    """Whether the bytes (N,) start like a TIFF file; a BigTIFF does not."""
    return buffer[:4].tobytes() in _ORDERS


def tiff_size_hw(buffer: NDArray[np.uint8], max_px: int) -> tuple[int, int]:
    """Height and width in pixels of the TIFF file (N,).

    Raises ImageError for more than `max_px` pixels in its tiles, for parts that have more bytes than the file
    together, and for a compression other than none, LZW, Deflate and PackBits.
    """
    tags = _directory(buffer, _ORDERS[buffer[:4].tobytes()])
    height, width = _number(tags, _HEIGHT, 0), _number(tags, _WIDTH, 0)
    check_size(height, width)
    tile_hw = max(_number(tags, _TILE_HEIGHT, 1), 1), max(_number(tags, _TILE_WIDTH, 1), 1)
    decoded_px = -(-height // tile_hw[0]) * tile_hw[0] * -(-width // tile_hw[1]) * tile_hw[1]
    parts = [tags[tag] for tag in _PART_BYTES if tag in tags]
    if decoded_px > max_px:
        raise ImageError(f"Expected a TIFF of at most {max_px} pixels, found {decoded_px} in its parts.")
    if not parts or sum(int(each.sum(dtype=np.uint64)) for each in parts) > buffer.size:
        raise ImageError(f"Expected parts of a TIFF of {buffer.size} bytes together, found another sum.")
    if not all(each.all() for each in parts):  # libtiff would take the rest of the file for each
        raise ImageError("Expected the number of bytes of each part of a TIFF, found 0.")
    if (compression := _number(tags, _COMPRESSION, 1)) not in _COMPRESSIONS:
        known = ", ".join(dict.fromkeys(_COMPRESSIONS.values()))
        raise ImageError(f"Expected one of the compressions {known} in a TIFF, found number {compression}.")
    return height, width


def _directory(buffer: NDArray[np.uint8], order: str) -> _Directory:
    """The values of the numeric tags of the first directory."""
    start = int(_values(buffer, f"{order}u4", 1, 4)[0])
    count = int(_values(buffer, f"{order}u2", 1, start)[0])
    entry = [(name, f"{order}u{size}") for name, size in _ENTRY]
    tags: _Directory = {}
    for number, (tag, kind, length, value) in enumerate(_values(buffer, entry, count, start + 2).tolist()):
        if tag <= max(tags, default=-1):
            raise ImageError("Expected the tags of a TIFF in order, each once, found others.")
        size = _VALUE_BYTES.get(kind, 0)
        place = value if length * size > 4 else start + 2 + 12 * number + 8
        tags[tag] = _values(buffer, f"{order}u{size}", length, place) if size else np.zeros(0, np.uint8)
    return tags


def _values(buffer: NDArray[np.uint8], kind: Any, count: int, offset: int) -> NDArray[Any]:
    try:
        return np.frombuffer(buffer, kind, count, offset)
    except ValueError:
        raise ImageError(f"Expected a complete TIFF, found {buffer.size} bytes.") from None


def _number(tags: _Directory, tag: int, default: int) -> int:
    """The first value of a tag."""
    return int(tags[tag][0]) if tag in tags and tags[tag].size else default
