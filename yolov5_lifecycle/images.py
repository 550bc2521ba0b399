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


class ImageError(ValueError):
    """A buffer that holds no picture we can use; the message says what was expected and what was found."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels and the order of their colours, so that nobody needs a pass over them to agree.

    Raises ImageError at birth when `pixels` is no uint8 array of shape (H, W, 3) with sides in [1, 16384].
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
    conversion: int | None  # OpenCV's code to three channels; None where the buffer has them already


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


def decode_raw(data: Any, *, encoding: str, height: int, width: int, step: int, is_bigendian: bool) -> Picture:
    """The picture in an uncompressed buffer, laid out as in sensor_msgs/Image.

    `data` is any contiguous buffer (bytes, array.array, memoryview, ndarray); `step` is the bytes from one row to the
    next. rgb8 and bgr8 give a read-only view of `data`, the others one copy. `is_bigendian` may be anything, as a
    pixel value is one byte in every encoding understood.

    Raises ImageError when the encoding is another or the buffer does not hold what the numbers claim.
    """
    if encoding not in ENCODINGS:
        raise ImageError(f"Encoding '{encoding[:40]}' is not supported. Supported: {', '.join(ENCODINGS)}.")
    channels, order, conversion = ENCODINGS[encoding]
    _check_size(height, width)
    row_bytes = width * channels
    if step < row_bytes:
        raise ImageError(
            f"A row of {width} {encoding} pixels needs a step of at least {row_bytes} bytes, found {step}."
        )
    buffer = _bytes_of(data)
    needed = step * (height - 1) + row_bytes
    if buffer.size < needed:
        raise ImageError(
            f"{height} rows of {step} bytes need at least {needed} bytes of data, found {buffer.size}."
        )
    pixels: NDArray[np.uint8] = np.ndarray((height, width, channels), np.uint8, buffer, strides=(step, channels, 1))
    if conversion is not None:
        return Picture(np.asarray(cv2.cvtColor(pixels, conversion), np.uint8), order)
    pixels.flags.writeable = False
    return Picture(pixels, order)


def decode_compressed(data: Any) -> Picture:
    """The picture in a JPEG or PNG file image, `data` as for `decode_raw`; the rotation a camera may note is ignored.

    Raises ImageError when it cannot be decoded.
    """
    buffer = _bytes_of(data)
    pixels = None
    if buffer.size:
        pixels = cv2.imdecode(buffer, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise ImageError(f"Expected a JPEG or PNG image, found {buffer.size} bytes that cannot be decoded.")
    return Picture(np.asarray(pixels, np.uint8), "bgr")


def _check_size(height: int, width: int) -> None:
    if not (1 <= height <= MAX_SIDE_PX and 1 <= width <= MAX_SIDE_PX):
        raise ImageError(f"Height and width must lie in 1 to {MAX_SIDE_PX} pixels, found {height} x {width}.")


def _bytes_of(data: Any) -> NDArray[np.uint8]:
    try:
        return np.frombuffer(data, np.uint8)
    except (TypeError, ValueError, BufferError) as error:
        raise ImageError(f"Expected a contiguous buffer of bytes, found {type(data).__name__}: {error}.") from None
