"""The pictures in messages that have the fields of sensor_msgs, whoever deserialised them."""

from __future__ import annotations

from typing import Any

from yolov5_lifecycle.compressed_image import decode_compressed
from yolov5_lifecycle.images import Picture
from yolov5_lifecycle.raw_image import decode_raw


def raw_picture(image: Any) -> Picture:
    """The picture in a sensor_msgs/Image, without a copy where the encoding allows; raises ImageError."""
    return decode_raw(
        image.data,
        encoding=image.encoding,
        height=image.height,
        width=image.width,
        step=image.step,
        is_bigendian=bool(image.is_bigendian),
    )


def compressed_picture(image: Any) -> Picture:
    """The picture in a sensor_msgs/CompressedImage; raises ImageError."""
    return decode_compressed(image.data, format_text=image.format)
