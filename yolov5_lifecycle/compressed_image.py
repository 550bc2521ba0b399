"""JPEG and PNG files, and the pictures they hold."""

from __future__ import annotations

import sys
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.image_encoding import encoded
from yolov5_lifecycle.images import ImageError, Picture, bytes_of, check_size
from yolov5_lifecycle.raw_image import decode_raw

MAX_COMPRESSED_PX = 1 << 26
"""A file of a few kilobytes may claim any size; this many pixels take 200 MB once decoded."""

JPEG_QUALITY = 80
"""Of 100: half the bytes of OpenCV's 95; letters and thin lines stay clean."""

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_VALUES: dict[str, type[np.unsignedinteger[Any]]] = {
    "16UC1": np.uint16,
    **dict.fromkeys(("bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"), np.uint8),
}
"""Encodings of which a PNG holds the values as they were, not what they look like, and their type."""


def decode_compressed(data: Any, *, format_text: str = "") -> Picture:
    """The picture in the bytes of a JPEG or PNG file, `data` as for `decode_raw`.

    `format_text` is the message's `format`, such as "rgb8; jpeg compressed bgr8"; empty and unknown ones mean
    a picture in the file's own colours. A PNG of 16UC1 or of a Bayer mosaic is decoded as `decode_raw` does.
    Of other files with 16 bits the higher 8 are kept; transparency is dropped.

    The pixels as they are stored: a rotation that the file asks for (EXIF) is not made.

    Raises ImageError when it is another format, larger than MAX_COMPRESSED_PX or cannot be decoded.
    """
    if "compressedDepth" in format_text:
        raise ImageError(
            f"Format {format_text[:40]!r} is of the transport compressedDepth, which is not supported; "
            "subscribe to the raw 16UC1 image instead, or publish it through the transport compressed."
        )
    buffer = bytes_of(data)
    height, width = _claimed_size_hw(buffer)
    check_size(height, width)
    if height * width > MAX_COMPRESSED_PX:
        raise ImageError(
            f"A compressed picture may have {MAX_COMPRESSED_PX} pixels, this one claims {height} x {width}."
        )
    encoding = format_text.partition(";")[0].strip()
    if encoding in _VALUES and _begins(buffer, _PNG):
        return _decode_values(buffer, encoding)
    pixels = _decoded(buffer, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    # "rgb" says that who compressed it took red for blue; image_transport undoes that in the same way.
    return Picture(pixels, "rgb" if "compressed rgb" in format_text else "bgr")


def encode_jpeg(picture: Picture, encoding: Literal["bgr8", "mono8"] = "bgr8") -> NDArray[np.uint8]:
    """The bytes (N,) of a JPEG file with that picture, in colours or in greys.

    Raises ImageError when OpenCV cannot make it.
    """
    try:
        is_encoded, data = cv2.imencode(
            ".jpg", encoded(picture, encoding), (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)
        )
    except cv2.error as error:
        raise ImageError(f"OpenCV cannot compress the picture: {error.err}.") from None
    if not is_encoded:
        raise ImageError("OpenCV cannot compress the picture.")
    return np.asarray(data, np.uint8).reshape(-1)


def _decode_values(buffer: NDArray[np.uint8], encoding: str) -> Picture:
    values = _decoded(buffer, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    if values.dtype != _VALUES[encoding]:
        expected = np.dtype(_VALUES[encoding]).name
        raise ImageError(f"Expected a PNG of {expected} values for {encoding}, found {values.dtype}.")
    height, width = values.shape[:2]
    return decode_raw(
        values,
        encoding=encoding,
        height=height,
        width=width,
        step=width * values.itemsize,
        is_bigendian=sys.byteorder == "big",
    )


def _decoded(buffer: NDArray[np.uint8], flags: int) -> NDArray[Any]:
    try:
        pixels = cv2.imdecode(buffer, flags)
    except cv2.error as error:
        raise ImageError(f"OpenCV refuses the compressed picture: {error.err}.") from None
    if pixels is None:
        raise ImageError(f"Expected a whole JPEG or PNG, found {buffer.size} bytes that cannot be decoded.")
    return np.ascontiguousarray(pixels)


def _begins(buffer: NDArray[np.uint8], start: bytes) -> bool:
    return buffer[: len(start)].tobytes() == start


def _claimed_size_hw(buffer: NDArray[np.uint8]) -> tuple[int, int]:
    """Height and width that a PNG or JPEG claims, read without decoding it."""
    if _begins(buffer, _PNG):
        return _png_size_hw(buffer.data)
    if _begins(buffer, _JPEG):
        return _jpeg_size_hw(buffer.data)
    start = buffer[:8].tobytes().hex()
    raise ImageError(f"Expected a JPEG or PNG, found {buffer.size} bytes that begin with {start}.")


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
