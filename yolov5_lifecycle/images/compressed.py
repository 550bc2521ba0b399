"""Decoding and encoding of compressed images: JPEG, PNG and image files."""

from __future__ import annotations

import re
import sys
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.encodings import decode_raw, encoded, layout_of
from yolov5_lifecycle.images.file_structure import (
    FileStructure,
    is_jpeg,
    is_png,
    jpeg_structure,
    png_structure,
)
from yolov5_lifecycle.images.image import ColourImage, ImageError, bytes_of, check_frame_id, check_size
from yolov5_lifecycle.process.environment import MAX_COMPRESSED_PX

JPEG_QUALITY = 80
"""Out of 100: half the bytes of OpenCV's default 95; text and thin lines stay clean."""

_VALUES = re.compile("bayer_|mono16|8SC|(16|32|64)[USF]C")
"""Beginnings of the encodings whose file holds values to convert like those of a raw image."""

_BOUNDED_BY_OPENCV = re.compile(rb"BM|RIFF....WEBP", re.DOTALL)
"""Beginnings of BMP and WebP files. OpenCV reads more, whose cost nobody has counted."""

_SET_PNG = "Set the parameter `compressed.format` of the publisher to png if it is image_transport's"


def compressed_image(image: Any) -> ColourImage:
    """Decode a sensor_msgs/CompressedImage, deserialised by any library; see `decode_compressed`.

    Raises ImageError, also for a frame_id longer than MAX_FRAME_ID, before anything is decoded.
    """
    check_frame_id(image)
    return decode_compressed(image.data, format_text=image.format)


def decode_compressed(data: Any, *, format_text: str = "") -> ColourImage:
    """Decode a JPEG or PNG file; `data` as for `decode_raw`.

    `format_text` is the message's `format`, such as "rgb8; jpeg compressed bgr8": what the file holds follows
    `compressed`, or is the camera's encoding if nothing does. A mosaic and 16-bit grey are decoded like in
    `decode_raw`; everything else, also empty and unknown, selects the file's own colours. Of other 16-bit
    files the high byte is kept; transparency is dropped. CMYK is converted by OpenCV.

    EXIF rotation is ignored: pixels are returned as stored.

    Raises ImageError for another format, a file that cannot hold what `format_text` names, an image larger
    than MAX_COMPRESSED_PX, or one that exceeds the limits of `jpeg_structure` and `png_structure`.
    """
    if "compressedDepth" in format_text:
        raise ImageError(
            f"Format {format_text[:40]!r} is of the transport compressedDepth, which is not supported; "
            "subscribe to the raw 16UC1 image instead, or publish it through the transport compressed."
        )
    file = _checked(
        bytes_of(data), "JPEG or PNG", f"{_SET_PNG}, which sends nothing where it cannot make a JPEG"
    )
    target = format_text.partition("compressed")[2].strip()
    held = target or format_text.partition(";")[0].strip()
    if _VALUES.match(held):
        return _decode_values(file, held)
    pixels = _decoded(file.data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    # The encoder swapped red and blue; image_transport swaps them back the same way.
    return ColourImage(pixels, "rgb" if target.startswith("rgb") else "bgr")


def decode_image_file(data: NDArray[np.uint8]) -> ColourImage:
    """Decode an image file (N,), a JPEG, PNG, WebP or BMP, rotated as its EXIF data specify.

    JPEG and PNG are checked as in `decode_compressed`; what WebP and BMP cost depends on their pixels alone,
    for which `prepare_environment` sets OpenCV's own limit. Raises ImageError when it is larger or cannot be
    decoded, and for any other format.
    """
    if not _BOUNDED_BY_OPENCV.match(data[:12].tobytes()):
        data = _checked(data, "JPEG, PNG, WebP or BMP", "Convert it to PNG").data
    return ColourImage(_decoded(data, cv2.IMREAD_COLOR), "bgr")


def encode_jpeg(
    image: ColourImage, encoding: Literal["bgr8", "mono8"] = "bgr8", *, quality: int = JPEG_QUALITY
) -> NDArray[np.uint8]:
    """Encode an image as a JPEG file (N,), in colour or greyscale; `quality` from 1 to 100.

    Raises ImageError when OpenCV cannot encode it.
    """
    try:
        is_encoded, data = cv2.imencode(".jpg", encoded(image, encoding), (cv2.IMWRITE_JPEG_QUALITY, quality))
    except cv2.error as error:
        raise ImageError(f"OpenCV cannot compress the image: {error.err}.") from None
    if not is_encoded:
        raise ImageError("OpenCV cannot compress the image.")
    return np.asarray(data, np.uint8).reshape(-1)


def _checked(buffer: NDArray[np.uint8], expected: str, remedy: str) -> FileStructure:
    """The file, if decoding it takes bounded memory and time; else ImageError."""
    if is_png(buffer):
        file = png_structure(buffer)
    elif is_jpeg(buffer):
        file = jpeg_structure(buffer)
    else:
        beginning = buffer[:8].tobytes().hex() or "nothing"
        raise ImageError(
            f"Expected a {expected}, found {buffer.size} bytes that begin with {beginning}. {remedy}."
        )
    height, width = file.size_hw
    check_size(height, width)
    if height * width > MAX_COMPRESSED_PX:
        raise ImageError(
            f"A compressed image may have {MAX_COMPRESSED_PX} pixels, this one claims {height} x {width}."
        )
    return file


def _decode_values(file: FileStructure, encoding: str) -> ColourImage:
    bits = 8 * layout_of(encoding).pixel_bytes
    if file.grey_bits != bits:
        found = "colours" if file.grey_bits is None else f"{file.grey_bits} bits"
        raise ImageError(
            f"Expected a file of grey values of {bits} bits for {encoding}, found {found}. {_SET_PNG}, or "
            "have the publisher name after 'compressed' what the file holds, such as bgr8 or mono8."
        )
    values = _decoded(file.data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    height, width = values.shape
    return decode_raw(
        values,
        encoding=encoding,
        height=height,
        width=width,
        step=width * values.itemsize,
        is_bigendian=sys.byteorder == "big",
    )


def _decoded(file: NDArray[np.uint8], flags: int) -> NDArray[Any]:
    try:
        pixels = cv2.imdecode(file, flags)
    except cv2.error as error:
        raise ImageError(f"OpenCV refuses the image: {error.err}.") from None
    if pixels is None:
        raise ImageError(f"Expected a complete image, found {file.size} bytes that cannot be decoded.")
    return np.ascontiguousarray(pixels)
