"""Image buffers as cameras send them, and the picture they hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Order = Literal["rgb", "bgr"]

MAX_SIDE_PX = 16384
"""Wider or higher pictures are refused: no camera makes them, but a damaged message may claim them."""

MAX_COMPRESSED_PX = 1 << 26
"""A file of a few kilobytes may claim any size; this many pixels take 200 MB once decoded."""


class ImageError(ValueError):
    """A buffer that holds no picture we can use; says what was expected and what was found."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels and the order of their colours, so that nobody needs a pass over them to agree.

    Raises ImageError at birth when `pixels` is no uint8 array (H, W, 3) with sides in [1, 16384].
    """

    pixels: NDArray[np.uint8]
    """(H, W, 3), maybe a read-only view with padded rows."""
    order: Order

    def __post_init__(self) -> None:
        shape, dtype = self.pixels.shape, self.pixels.dtype
        if len(shape) != 3 or shape[2] != 3 or dtype != np.uint8:
            raise ImageError(f"Pixels must be uint8 of shape (H, W, 3), found {dtype} of shape {shape}.")
        _check_size(shape[0], shape[1])

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width, _ = self.pixels.shape
        return height, width


class _Encoding(NamedTuple):
    channels: int
    order: Order
    conversion: int | None  # OpenCV's code to three channels, None where the buffer has them already


ENCODINGS: Mapping[str, _Encoding] = MappingProxyType(
    {
        "rgb8": _Encoding(3, "rgb", None),
        "bgr8": _Encoding(3, "bgr", None),
        "mono8": _Encoding(1, "rgb", cv2.COLOR_GRAY2RGB),
        "rgba8": _Encoding(4, "rgb", cv2.COLOR_RGBA2RGB),
        "bgra8": _Encoding(4, "bgr", cv2.COLOR_BGRA2BGR),
    }
)
"""The encodings of sensor_msgs/Image that are understood, by name."""


def decode_raw(
    data: Any, *, encoding: str, height: int, width: int, step: int, is_bigendian: bool
) -> Picture:
    """The picture in an uncompressed buffer, laid out as in sensor_msgs/Image.

    `data` is any contiguous buffer (bytes, array.array, memoryview, ndarray); `step` is the bytes from one
    row to the next. rgb8 and bgr8 give a read-only view of `data`, the others one copy. `is_bigendian` may
    be either: every encoding understood has values of one byte.

    Raises ImageError when the encoding is another or the buffer does not hold what the numbers claim.
    """
    if encoding not in ENCODINGS:
        raise ImageError(f"Encoding {encoding[:40]!r} is not supported; supported: {', '.join(ENCODINGS)}.")
    channels, order, conversion = ENCODINGS[encoding]
    buffer = _bytes_of(data)
    _check_layout(buffer.size, encoding, height=height, width=width, step=step)
    pixels: NDArray[np.uint8] = np.ndarray(
        (height, width, channels), np.uint8, buffer, strides=(step, channels, 1)
    )
    if conversion is not None:
        return Picture(cv2.cvtColor(pixels, conversion), order)
    pixels.flags.writeable = False
    return Picture(pixels, order)


def decode_compressed(data: Any) -> Picture:
    """The picture in the bytes of a JPEG or PNG file, `data` as for `decode_raw`.

    The pixels as they are stored: a rotation that the file asks for (EXIF) is not made.

    Raises ImageError when it is another format, larger than MAX_COMPRESSED_PX or cannot be decoded.
    """
    buffer = _bytes_of(data)
    height, width = _compressed_size_hw(buffer)
    _check_size(height, width)
    if height * width > MAX_COMPRESSED_PX:
        raise ImageError(
            f"A compressed picture may have {MAX_COMPRESSED_PX} pixels, this one claims {height} x {width}."
        )
    try:
        pixels = cv2.imdecode(buffer, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ImageError(f"OpenCV refuses the compressed picture: {error.err}.") from None
    if pixels is None:
        raise ImageError(f"Expected a whole JPEG or PNG, found {buffer.size} bytes that cannot be decoded.")
    return Picture(pixels, "bgr")


def _check_size(height: int, width: int) -> None:
    if not (1 <= height <= MAX_SIDE_PX and 1 <= width <= MAX_SIDE_PX):
        raise ImageError(f"Height and width must be 1 to {MAX_SIDE_PX} pixels, found {height} x {width}.")


def _check_layout(size: int, encoding: str, *, height: int, width: int, step: int) -> None:
    _check_size(height, width)
    row_size = width * ENCODINGS[encoding].channels
    if step < row_size:
        raise ImageError(f"Rows of {width} {encoding} pixels need a step >= {row_size}, found {step}.")
    needed = step * (height - 1) + row_size  # the last row may come without its padding
    if size < needed:
        raise ImageError(
            f"{height} rows of {width} {encoding} pixels with step {step} need {needed} bytes, found {size}."
        )


def _bytes_of(data: Any) -> NDArray[np.uint8]:
    try:
        return np.frombuffer(data, np.uint8)
    except (TypeError, ValueError, BufferError):
        raise ImageError(f"Expected a contiguous buffer of bytes, found {type(data).__name__}.") from None


def _compressed_size_hw(buffer: NDArray[np.uint8]) -> tuple[int, int]:
    """Height and width that a PNG or JPEG claims, read without decoding it."""
    start = buffer[:8].tobytes()
    if start == b"\x89PNG\r\n\x1a\n":
        return _png_size_hw(buffer.data)
    if start[:2] == b"\xff\xd8":
        return _jpeg_size_hw(buffer.data)
    raise ImageError(f"Expected a JPEG or PNG, found {buffer.size} bytes that begin with {start.hex()}.")


def _png_size_hw(data: memoryview) -> tuple[int, int]:
    """The size in the first chunk; all chunks must be there, as OpenCV 5 sets 4 GB aside if one says so."""
    position = 8
    while position < len(data):
        position += 12 + _number(data, position, 4)
    if position != len(data) or position < 45:
        raise ImageError(f"Expected a whole PNG, found {len(data)} bytes that end within a chunk.")
    return _number(data, 20, 4), _number(data, 16, 4)


def _jpeg_size_hw(data: memoryview) -> tuple[int, int]:
    """The size in the frame header, found by walking over the segments before it (ITU-T T.81, annex B)."""
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return _number(data, position + 5, 2), _number(data, position + 7, 2)
        is_fill = marker == 0xFF
        position += 1 if is_fill else 2 + _number(data, position + 2, 2)
    raise ImageError(f"Expected a whole JPEG, found {len(data)} bytes without a frame header.")


def _number(data: memoryview, position: int, size: int) -> int:
    return int.from_bytes(data[position : position + size], "big")
