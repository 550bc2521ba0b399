"""Compressed images: JPEG, PNG and image files, and what decoding them would cost, by their structure.

Markers of JPEG: ITU-T T.81, annex B; they are found as libjpeg finds them, so that both see the same image.
Chunks of PNG: https://www.w3.org/TR/png-3/.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.encodings import ENCODINGS, decode_raw, encoded
from yolov5_lifecycle.images.image import ColourImage, ImageError, bytes_of, check_frame_id, check_size
from yolov5_lifecycle.process.environment import MAX_COMPRESSED_PX

JPEG_QUALITY = 80
"""Out of 100: half the bytes of OpenCV's default 95; text and thin lines stay clean."""

_MOSAICS = frozenset(name for name in ENCODINGS if name.startswith("bayer_"))
_VALUES = re.compile("bayer_|8SC|(16|32|64)[USF]C")
"""Beginnings of the encodings whose file holds values that are no colours."""

_BOUNDED_BY_OPENCV = re.compile(rb"BM|RIFF....WEBP", re.DOTALL)
"""Beginnings of BMP and WebP files. OpenCV reads more, whose cost nobody has counted."""

_REMEDY = (
    "Subscribe to the raw image, or set the parameter `compressed.format` of the publisher to png if it is "
    "image_transport's"
)

MAX_SCANS = 100
"""Encoders write 1 scan, or about 10 for progressive files."""
MAX_SCANNED_PX = 1 << 28
"""Scans x pixels: the decoder visits every pixel for each scan, even an empty one."""
MAX_SEGMENTS = 1000
"""libjpeg allocates 80 bytes for an APP1 segment of 4 bytes."""
MAX_CHUNKS = 1 << 16
"""Encoders split the pixels into chunks of at least 8 KiB."""

_MARKER = re.compile(rb"\xff([^\x00\xff\xd0-\xd7])", re.DOTALL)
"""FF00 is a data byte, more FF fill up, FFD0 to FFD7 restart the decoder within a scan."""
_WINDOW_BYTES = 1 << 16
"""Searched at once, because other threads wait meanwhile."""
_SOS, _EOI = 0xDA, 0xD9
_FRAMES = {0xC0, 0xC1, 0xC2}  # baseline, extended sequential, progressive: Huffman-coded
_SKIPPED = {0xC4, 0xDB, 0xDC, 0xDD, *range(0xE0, 0xF0), 0xFE}  # DHT, DQT, DNL, DRI, APPn, COM
_COMPONENTS = {1, 3, 4}  # grey, YCbCr or RGB, CMYK or YCCK: the ones that OpenCV decodes

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_HEADER = b"\0\0\0\x0dIHDR"  # 13 bytes follow
_AROUND_DATA = 12  # length and name before the data of a chunk, checksum after them
_ONCE = {b"IHDR", b"PLTE", b"tRNS", b"eXIf", b"IEND"}
_COLOURED = 3  # bits of the colour type: a palette, colours


def compressed_image(image: Any) -> ColourImage:
    """Decode a sensor_msgs/CompressedImage, deserialised by any library; see `decode_compressed`.

    Raises ImageError, also for a frame_id longer than MAX_FRAME_ID, before anything is decoded.
    """
    check_frame_id(image)
    return decode_compressed(image.data, format_text=image.format)


def decode_compressed(data: Any, *, format_text: str = "") -> ColourImage:
    """Decode a JPEG or PNG file; `data` as for `decode_raw`.

    `format_text` is the message's `format`, such as "rgb8; jpeg compressed bgr8": what the file holds follows
    `compressed`, or is the camera's encoding if nothing does. A mosaic of 8 bits is decoded like in
    `decode_raw`; everything but other values that are no colours, also empty and unknown, selects the file's
    own colours. Of 16-bit files the high byte is kept; transparency is dropped. CMYK is converted by OpenCV.
    A JPEG has 8 bits, and so it is no mono16.

    EXIF rotation is ignored: pixels are returned as stored.

    Raises ImageError for another format, other values that are no colours, a file that cannot hold the
    mosaic, an image larger than MAX_COMPRESSED_PX, or one that exceeds the limits of `jpeg_structure` and
    `png_structure`.
    """
    if "compressedDepth" in format_text:
        raise ImageError(
            f"Format {format_text[:40]!r} is of the transport compressedDepth, which is not supported; "
            "subscribe to the raw 16UC1 image instead."
        )
    target = format_text.partition("compressed")[2].strip()
    held = target or format_text.partition(";")[0].strip()
    if _VALUES.match(held) and held not in _MOSAICS:
        raise ImageError(_told_values(held))
    buffer = bytes_of(data)
    if held == "mono16" and is_jpeg(buffer):
        raise ImageError(f"Expected a PNG of mono16, found a JPEG, which is clipped to 8 bits. {_REMEDY}.")
    file = _checked(buffer, "JPEG or PNG", _REMEDY)
    if held in _MOSAICS:
        return _decode_mosaic(file, held)
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
    if buffer[: len(_SIGNATURE)].tobytes() == _SIGNATURE:
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


def _told_values(encoding: str) -> str:
    """Why a file of values in `encoding` is refused."""
    remedy = "Subscribe to the raw image, or have" if encoding in ENCODINGS else "Have"
    return (
        f"A compressed image of {encoding[:40]!r} is not supported. {remedy} the publisher send colours or "
        "grey of 8 bits, and name them after 'compressed', such as bgr8 or mono8."
    )


def _decode_mosaic(file: FileStructure, encoding: str) -> ColourImage:
    if file.grey_bits != 8:
        found = "colours" if file.grey_bits is None else f"{file.grey_bits} bits"
        raise ImageError(
            f"Expected a file of grey values of 8 bits for {encoding}, found {found}. Subscribe to the raw "
            "image, or have the publisher name after 'compressed' what the file holds, such as bgr8 or mono8."
        )
    values = _decoded(file.data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    height, width = values.shape
    return decode_raw(values, encoding=encoding, height=height, width=width, step=width, is_bigendian=False)


def _decoded(file: NDArray[np.uint8], flags: int) -> NDArray[Any]:
    try:
        pixels = cv2.imdecode(file, flags)
    except cv2.error as error:
        raise ImageError(f"OpenCV refuses the image: {error.err}.") from None
    if pixels is None:
        raise ImageError(f"Expected a complete image, found {file.size} bytes that cannot be decoded.")
    return np.ascontiguousarray(pixels)


@dataclass(frozen=True, eq=False)
class FileStructure:
    """A JPEG or PNG file (N,), reduced to what decoding the pixels needs, and what its header says."""

    data: NDArray[np.uint8]
    size_hw: tuple[int, int]
    grey_bits: int | None
    """Per value; None if the file has colours."""


def is_jpeg(buffer: NDArray[np.uint8]) -> bool:
    """Whether the bytes (N,) start with the JPEG signature."""
    return buffer[:3].tobytes() == b"\xff\xd8\xff"


def jpeg_structure(buffer: NDArray[np.uint8]) -> FileStructure:
    """The structure of a JPEG file (N,).

    Raises ImageError for files that OpenCV does not decode, for unusual structure such as a second frame
    header, and beyond MAX_SEGMENTS, MAX_SCANS or MAX_SCANNED_PX.
    """
    data, position, scans = buffer.data, 2, 0
    frame_hwc = None
    for _ in range(MAX_SEGMENTS):
        found = _next_marker(data, position)
        if found is None or found[1][0] == _EOI:
            break
        marker, position = found[1][0], found.end()
        is_expected = marker in _SKIPPED or marker in (_FRAMES if frame_hwc is None else {_SOS})
        if not is_expected:
            raise ImageError(
                "Expected a baseline or progressive JPEG with one frame header, before its scans, found "
                f"marker FF{marker:02X} at byte {position - 2}. Save it as a baseline JPEG."
            )
        segment = _segment(data, position, marker)
        if marker in _FRAMES:
            frame_hwc = _frame_hwc(segment)
        scans += marker == _SOS
        position += len(segment)
    else:
        raise ImageError(f"A JPEG may have {MAX_SEGMENTS} segments, this one has more.")
    if frame_hwc is None or not scans:
        raise ImageError(f"Expected a complete JPEG, found {len(data)} bytes without a scan.")
    height, width, components = frame_hwc
    if scans > MAX_SCANS or scans * height * width > MAX_SCANNED_PX:
        raise ImageError(
            f"A JPEG may have {MAX_SCANS} scans, and {MAX_SCANNED_PX} scans x pixels; "
            f"this one has {scans} of {height} x {width}. Save it as a baseline JPEG."
        )
    return FileStructure(buffer, (height, width), 8 if components == 1 else None)


def _next_marker(data: memoryview, position: int) -> re.Match[bytes] | None:
    for start in range(position, len(data), _WINDOW_BYTES):
        if found := _MARKER.search(data, start, start + _WINDOW_BYTES + 1):
            return found
    return None


def _segment(data: memoryview, position: int, marker: int) -> memoryview:
    """The segment at `position`, with its length in the first two bytes."""
    length = int.from_bytes(data[position : position + 2], "big")
    if length < 2 or position + length > len(data):
        raise ImageError(
            f"Expected a complete JPEG, found {len(data)} bytes in which marker FF{marker:02X} claims "
            f"{length} bytes at {position}."
        )
    return data[position : position + length]


def _frame_hwc(segment: memoryview) -> tuple[int, int, int]:
    """Height, width and components in a frame header: length, bits, the three, 3 bytes per component."""
    _, bits, height, width, components = struct.unpack(">HBHHB", bytes(segment[:8]).ljust(8, b"\0"))
    if bits != 8 or components not in _COMPONENTS or len(segment) != 8 + 3 * components:
        raise ImageError(
            f"Expected a JPEG of 8 bits and 1, 3 or 4 components, found {bits} bits and {components} "
            f"components in a header of {len(segment)} bytes. Save it as a baseline JPEG."
        )
    return height, width, components


def png_structure(buffer: NDArray[np.uint8]) -> FileStructure:
    """The structure of a PNG file (N,).

    Text, colour profiles and animation are stripped: libpng would decompress up to 8 MB of each, a thousand
    times. So is everything else that a still image needs not, or has twice, and what follows its end.

    Raises ImageError when a chunk extends beyond the file, for a file that does not begin with its header or
    has no pixels, and for more than MAX_CHUNKS.
    """
    data, position = buffer.data, len(_SIGNATURE)
    kept, found = list[memoryview](), set[bytes]()
    for _ in range(MAX_CHUNKS):
        length, name = (
            int.from_bytes(data[position : position + 4], "big"),
            bytes(data[position + 4 : position + 8]),
        )
        chunk = data[position : position + _AROUND_DATA + length]
        if len(chunk) < _AROUND_DATA + length:
            raise ImageError(f"Expected a complete PNG, found {len(data)} bytes that end within a chunk.")
        if name == b"IDAT" or name in _ONCE - found:
            kept.append(chunk)
        found.add(name)
        position += len(chunk)
        if name == b"IEND":
            break
    else:
        raise ImageError(f"A PNG may have {MAX_CHUNKS} chunks, this one has more.")
    if b"IDAT" not in found:
        raise ImageError(f"Expected a complete PNG, found {len(data)} bytes without pixels (IDAT).")
    if kept[0][: len(_HEADER)] != _HEADER:
        raise ImageError("Expected a PNG that begins with an IHDR of 13 bytes, found another beginning.")
    width, height, bits, colour = struct.unpack_from(">IIBB", kept[0], len(_HEADER))
    is_plain = len(_SIGNATURE) + sum(map(len, kept)) == position  # then it is not copied
    alone = buffer[:position] if is_plain else np.frombuffer(b"".join((_SIGNATURE, *kept)), np.uint8)
    return FileStructure(alone, (height, width), None if colour & _COLOURED else bits)
