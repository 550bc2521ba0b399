"""Uncompressed images in the encodings that cameras send, and the pictures they hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images import ImageError, Order, Picture, bytes_of, check_size


@dataclass(frozen=True, eq=False)
class _RawImage:
    """A buffer and its layout, as in sensor_msgs/Image."""

    buffer: NDArray[np.uint8]
    height: int
    width: int
    step: int
    is_bigendian: bool

    def rows(self, count: int, pixel_bytes: int) -> NDArray[np.uint8]:
        """A read-only view (count, W, pixel_bytes) of the first rows."""
        return self._view(count, pixel_bytes, 0, self.step)

    def chroma(self) -> NDArray[np.uint8]:
        """A read-only view (H, W, 2) of what follows the luma plane, in rows that are twice as long."""
        return self._view(self.height, 2, self.height * self.step, 2 * self.step)

    def _view(self, count: int, pixel_bytes: int, offset: int, step: int) -> NDArray[np.uint8]:
        shape, strides = (count, self.width, pixel_bytes), (step, pixel_bytes, 1)
        view: NDArray[np.uint8] = np.ndarray(shape, np.uint8, self.buffer, offset, strides)
        view.flags.writeable = False
        return view


Decode = Callable[[_RawImage], NDArray[np.uint8]]


def _as_sent(image: _RawImage) -> NDArray[np.uint8]:
    return image.rows(image.height, 3)


def _converted(pixels: NDArray[np.uint8], conversion: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)


def _by_opencv(conversion: int, *, pixel_bytes: int) -> Decode:
    return lambda image: _converted(image.rows(image.height, pixel_bytes), conversion)


def _half_chroma(conversion: int) -> Decode:
    return lambda image: _converted(image.rows(image.height * 3 // 2, 1), conversion)


def _high_bytes(image: _RawImage) -> NDArray[np.uint8]:
    high = 0 if image.is_bigendian else 1
    return _converted(image.rows(image.height, 2)[..., high], cv2.COLOR_GRAY2RGB)


def _stretched(image: _RawImage) -> NDArray[np.uint8]:
    """The smallest value of the picture black, its greatest white."""
    words = image.rows(image.height, 2).view(">u2" if image.is_bigendian else "<u2").astype(np.uint16)
    grey = cv2.normalize(words, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    return _converted(grey, cv2.COLOR_GRAY2RGB)


_BLACK_LUMA = 16
_RGB_OF_YUV = np.array(
    [
        [1.164, 0.0, 1.596, -_BLACK_LUMA * 1.164 - 128 * 1.596],
        [1.164, -0.392, -0.813, -_BLACK_LUMA * 1.164 + 128 * (0.392 + 0.813)],
        [1.164, 2.017, 0.0, -_BLACK_LUMA * 1.164 - 128 * 2.017],
    ],
    np.float32,
)
"""ITU-R BT.601, as OpenCV takes it for the other YUV encodings."""


def _full_chroma(image: _RawImage) -> NDArray[np.uint8]:
    # OpenCV has no conversion from NV24.
    luma = np.maximum(image.rows(image.height, 1), _BLACK_LUMA)
    return np.asarray(cv2.transform(np.concatenate((luma, image.chroma()), axis=2), _RGB_OF_YUV), np.uint8)


class _Encoding(NamedTuple):
    """`rows` for each row of the picture, of `pixel_bytes` for each pixel; `block_hw` must fit whole."""

    decode: Decode
    pixel_bytes: int
    order: Order = "rgb"
    rows: float = 1
    block_hw: tuple[int, int] = (1, 1)
    least_side_px: int = 1


def _bayer(conversion: int) -> _Encoding:
    # Of smaller pictures OpenCV makes black ones.
    return _Encoding(_by_opencv(conversion, pixel_bytes=1), 1, least_side_px=3)


_MONO8 = _Encoding(_by_opencv(cv2.COLOR_GRAY2RGB, pixel_bytes=1), 1)
_BGR8 = _Encoding(_as_sent, 3, "bgr")
_UYVY = _Encoding(_by_opencv(cv2.COLOR_YUV2RGB_UYVY, pixel_bytes=2), 2, block_hw=(1, 2))
_YUYV = _Encoding(_by_opencv(cv2.COLOR_YUV2RGB_YUYV, pixel_bytes=2), 2, block_hw=(1, 2))

ENCODINGS: Mapping[str, _Encoding] = MappingProxyType(
    {
        "rgb8": _Encoding(_as_sent, 3),
        "bgr8": _BGR8,
        "8UC3": _BGR8,
        "rgba8": _Encoding(_by_opencv(cv2.COLOR_RGBA2RGB, pixel_bytes=4), 4),
        "bgra8": _Encoding(_by_opencv(cv2.COLOR_BGRA2BGR, pixel_bytes=4), 4, "bgr"),
        "mono8": _MONO8,
        "8UC1": _MONO8,
        "mono16": _Encoding(_high_bytes, 2),
        "16UC1": _Encoding(_stretched, 2),
        "uyvy": _UYVY,
        "yuv422": _UYVY,
        "yuyv": _YUYV,
        "yuv422_yuy2": _YUYV,
        "nv12": _Encoding(_half_chroma(cv2.COLOR_YUV2RGB_NV12), 1, rows=1.5, block_hw=(2, 2)),
        "nv21": _Encoding(_half_chroma(cv2.COLOR_YUV2RGB_NV21), 1, rows=1.5, block_hw=(2, 2)),
        "nv24": _Encoding(_full_chroma, 1, rows=3),
        "bayer_rggb8": _bayer(cv2.COLOR_BayerRGGB2RGB),
        "bayer_bggr8": _bayer(cv2.COLOR_BayerBGGR2RGB),
        "bayer_gbrg8": _bayer(cv2.COLOR_BayerGBRG2RGB),
        "bayer_grbg8": _bayer(cv2.COLOR_BayerGRBG2RGB),
    }
)
"""The encodings of sensor_msgs/Image that are understood, by name; docs/images.md has a table."""


def decode_raw(
    data: Any, *, encoding: str, height: int, width: int, step: int, is_bigendian: bool
) -> Picture:
    """The picture in an uncompressed buffer, laid out as in sensor_msgs/Image.

    `data` is any contiguous buffer (bytes, array.array, memoryview, ndarray); `step` is the bytes from one
    row to the next. rgb8, bgr8 and 8UC3 give a read-only view of `data`, the others a copy. mono16 keeps the
    higher byte; 16UC1 is stretched from the smallest to the greatest value of the picture.

    Raises ImageError when the encoding is another or the buffer does not hold what the numbers claim.
    """
    if encoding not in ENCODINGS:
        raise ImageError(f"Encoding {encoding[:40]!r} is not supported; supported: {', '.join(ENCODINGS)}.")
    image = _RawImage(bytes_of(data), height, width, step, is_bigendian)
    _check_size(image, encoding)
    _check_layout(image, encoding)
    return Picture(ENCODINGS[encoding].decode(image), ENCODINGS[encoding].order)


def _check_size(image: _RawImage, encoding: str) -> None:
    height, width = image.height, image.width
    check_size(height, width)
    block_height, block_width = ENCODINGS[encoding].block_hw
    if height % block_height or width % block_width:
        raise ImageError(
            f"Pixels of {encoding} come in blocks of {block_height} x {block_width}: expected a height and a "
            f"width of whole blocks, found {height} x {width}."
        )
    if min(height, width) < (least_px := ENCODINGS[encoding].least_side_px):
        raise ImageError(
            f"Sides of {encoding} pictures must be at least {least_px} pixels, found {height} x {width}."
        )


def _check_layout(image: _RawImage, encoding: str) -> None:
    height, width, step, layout = image.height, image.width, image.step, ENCODINGS[encoding]
    row_size = width * layout.pixel_bytes
    if step < row_size:
        raise ImageError(f"Rows of {width} {encoding} pixels need a step >= {row_size}, found {step}.")
    needed = step * (int(height * layout.rows) - 1) + row_size  # the last row may come without its padding
    if image.buffer.size < needed:
        raise ImageError(
            f"{height} rows of {width} {encoding} pixels with step {step} need {needed} bytes, "
            f"found {image.buffer.size}."
        )
