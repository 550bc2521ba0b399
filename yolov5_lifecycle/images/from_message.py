"""Images from sensor_msgs messages, deserialised by any library."""

from __future__ import annotations

from typing import Any

from yolov5_lifecycle.images.compressed import decode_compressed
from yolov5_lifecycle.images.encodings import decode_raw
from yolov5_lifecycle.images.image import Picture


def raw_picture(image: Any) -> Picture:
    """Decode a sensor_msgs/Image, without a copy where the encoding allows; raises ImageError."""
    return decode_raw(
        image.data,
        encoding=image.encoding,
        height=image.height,
        width=image.width,
        step=image.step,
        is_bigendian=bool(image.is_bigendian),
    )


def compressed_picture(image: Any) -> Picture:
    """Decode a sensor_msgs/CompressedImage; raises ImageError."""
    return decode_compressed(image.data, format_text=image.format)
