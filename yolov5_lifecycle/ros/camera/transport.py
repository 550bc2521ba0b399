"""Message forms of the camera's images: raw and compressed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.encodings import encoded
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.ros.messages import compressed_image_message, image_message

Transport = Literal["raw", "compressed", "both"]


def raw_message(image: ColourImage, encoding: str, header: Header) -> Image:
    """Image message of `image` in `encoding`."""
    return image_message(encoded(image, encoding), encoding, header)


def jpeg_message(image: ColourImage, encoding: str, header: Header) -> CompressedImage:
    """JPEG message of `image`, which image_transport decompresses to `encoding`."""
    jpeg = encode_jpeg(image, "mono8" if encoding == "mono8" else "bgr8")
    return compressed_image_message(jpeg, encoding, header)


class ImageForm(NamedTuple):
    """Topic suffix, message type, and the function that creates the message."""

    suffix: str
    message_type: type
    message: Callable[[ColourImage, str, Header], Any]


_RAW = ImageForm("", Image, raw_message)
_COMPRESSED = ImageForm("/compressed", CompressedImage, jpeg_message)

IMAGE_FORMS: dict[Transport, list[ImageForm]] = {
    "raw": [_RAW],
    "compressed": [_COMPRESSED],
    "both": [_RAW, _COMPRESSED],
}
