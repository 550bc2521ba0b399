"""Decoding and encoding of uncompressed images in the encodings of sensor_msgs/Image."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import (
    ChannelOrder,
    ColourImage,
    ImageError,
    check_frame_id,
    check_size,
    rows_of,
)

_CHANNELS = {"rgb8": "RGB", "bgr8": "BGR", "mono8": "GRAY", "rgba8": "RGBA", "bgra8": "BGRA"}


class GreyImage(ColourImage):
    """An image of grey pixels (H, W), which are converted to RGB when `pixels` are asked for."""

    channel_order: ChannelOrder = "rgb"

    def __init__(self, grey: NDArray[np.uint8]) -> None:
        object.__setattr__(self, "_grey", grey)
        self._grey: NDArray[np.uint8]

    @cached_property
    def pixels(self) -> NDArray[np.uint8]:
        """(H, W, 3) in RGB."""
        return np.asarray(cv2.cvtColor(self._grey, cv2.COLOR_GRAY2RGB), np.uint8)

    @property
    def size_hw(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self._grey.shape
        return height, width

    @property
    def as_sent(self) -> tuple[NDArray[np.uint8], ChannelOrder]:
        """The grey pixels and their order, which is grey."""
        return self._grey, "grey"


Decode = Callable[[NDArray[np.uint8], bool], NDArray[np.uint8]]
"""Rows (rows, W, bytes per pixel), and whether these are big-endian -> pixels (H, W, 3) or (H, W)."""


class _Layout(NamedTuple):
    """Memory layout of an encoding: buffer `rows` per image row, `pixel_bytes` per pixel.

    Image sides must be multiples of `block_hw` and at least `min_side_px`.
    """

    decode: Decode
    pixel_bytes: int
    channel_order: ChannelOrder = "rgb"
    rows: float = 1
    block_hw: tuple[int, int] = (1, 1)
    min_side_px: int = 1


def _as_sent(rows: NDArray[np.uint8], _: bool) -> NDArray[np.uint8]:
    return rows


def _converted(pixels: NDArray[np.uint8], conversion: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(pixels, conversion), np.uint8)


def _by_opencv(conversion: int) -> Decode:
    return lambda rows, _: _converted(rows, conversion)


def _grey(rows: NDArray[np.uint8], _: bool) -> NDArray[np.uint8]:
    return rows[..., 0]


def _high_bytes(rows: NDArray[np.uint8], is_bigendian: bool) -> NDArray[np.uint8]:
    return np.ascontiguousarray(rows[..., 0 if is_bigendian else 1])


def _stretched(rows: NDArray[np.uint8], is_bigendian: bool) -> NDArray[np.uint8]:
    """Contrast-stretched grey: the image minimum becomes black, the maximum white."""
    values = rows.view(">u2" if is_bigendian else "<u2").astype(np.uint16)
    return np.asarray(cv2.normalize(values, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U), np.uint8)


def _bayer(conversion: int) -> _Layout:
    # OpenCV turns smaller images black.
    return _Layout(_by_opencv(conversion), 1, min_side_px=3)


_BGR8 = _Layout(_as_sent, 3, "bgr")
_MONO8 = _Layout(_grey, 1, "grey")
_UYVY = _Layout(_by_opencv(cv2.COLOR_YUV2RGB_UYVY), 2, block_hw=(1, 2))
_YUYV = _Layout(_by_opencv(cv2.COLOR_YUV2RGB_YUYV), 2, block_hw=(1, 2))

ENCODINGS: Mapping[str, _Layout] = MappingProxyType(
    {
        "rgb8": _Layout(_as_sent, 3),
        "bgr8": _BGR8,
        "8UC3": _BGR8,
        "rgba8": _Layout(_by_opencv(cv2.COLOR_RGBA2RGB), 4),
        "bgra8": _Layout(_by_opencv(cv2.COLOR_BGRA2BGR), 4, "bgr"),
        "mono8": _MONO8,
        "8UC1": _MONO8,
        "mono16": _Layout(_high_bytes, 2, "grey"),
        "16UC1": _Layout(_stretched, 2, "grey"),
        "uyvy": _UYVY,
        "yuv422": _UYVY,
        "yuyv": _YUYV,
        "yuv422_yuy2": _YUYV,
        "nv12": _Layout(_by_opencv(cv2.COLOR_YUV2RGB_NV12), 1, rows=1.5, block_hw=(2, 2)),
        "nv21": _Layout(_by_opencv(cv2.COLOR_YUV2RGB_NV21), 1, rows=1.5, block_hw=(2, 2)),
        "bayer_rggb8": _bayer(cv2.COLOR_BayerRGGB2RGB),
        "bayer_bggr8": _bayer(cv2.COLOR_BayerBGGR2RGB),
        "bayer_gbrg8": _bayer(cv2.COLOR_BayerGBRG2RGB),
        "bayer_grbg8": _bayer(cv2.COLOR_BayerGRBG2RGB),
    }
)
"""Supported encodings of sensor_msgs/Image by name; docs/images.md has a table."""


def raw_image(image: Any) -> ColourImage:
    """Decode a sensor_msgs/Image, deserialised by any library; see `decode_raw`.

    Raises ImageError, also for a frame_id longer than MAX_FRAME_ID.
    """
    check_frame_id(image)
    fields = ("encoding", "height", "width", "step", "is_bigendian")
    return decode_raw(image.data, **{field: getattr(image, field) for field in fields})


def decode_raw(
    data: Any, *, encoding: str, height: int, width: int, step: int, is_bigendian: bool
) -> ColourImage:
    """Decode an uncompressed buffer with the layout of sensor_msgs/Image.

    `data` is any contiguous buffer (bytes, array.array, memoryview, ndarray); `step` is the row stride in
    bytes. rgb8, bgr8, 8UC3, mono8 and 8UC1 return a read-only view of `data`, the others a copy. mono16 keeps
    the high byte; 16UC1 is contrast-stretched between the min and max value of the image. Grey encodings
    return a `GreyImage`.

    Raises ImageError when the encoding is unsupported or the buffer is too small for the given layout.
    """
    if encoding not in ENCODINGS:
        raise ImageError(f"Encoding {encoding[:40]!r} is not supported; supported: {', '.join(ENCODINGS)}.")
    layout = ENCODINGS[encoding]
    check_size(height, width)
    block_height, block_width = layout.block_hw
    if height % block_height or width % block_width:
        raise ImageError(
            f"Pixels of {encoding} come in blocks of {block_height} x {block_width}: expected a height "
            f"and a width of whole blocks, found {height} x {width}."
        )
    if min(height, width) < layout.min_side_px:
        raise ImageError(
            f"Sides of {encoding} images must be at least {layout.min_side_px} pixels, "
            f"found {height} x {width}."
        )
    rows = rows_of(
        data,
        rows=int(height * layout.rows),
        width=width,
        pixel_bytes=layout.pixel_bytes,
        step=step,
        encoding=encoding,
    )
    pixels = layout.decode(rows, bool(is_bigendian))
    return GreyImage(pixels) if layout.channel_order == "grey" else ColourImage(pixels, layout.channel_order)


def encoded(image: ColourImage, encoding: str) -> NDArray[np.uint8]:
    """Pixels (H, W, channels) in `encoding`: rgb8, bgr8, mono8, rgba8 or bgra8; else KeyError."""
    present, wanted = image.channel_order.upper(), _CHANNELS[encoding]
    if present == wanted:
        return image.pixels
    pixels = _converted(image.pixels, getattr(cv2, f"COLOR_{present}2{wanted}"))
    return pixels.reshape(*image.size_hw, -1)  # OpenCV drops the axis of a single channel
