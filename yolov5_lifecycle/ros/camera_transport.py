"""The forms in which the camera sends a picture."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from yolov5_lifecycle.compressed_image import encode_jpeg
from yolov5_lifecycle.image_encoding import encoded
from yolov5_lifecycle.images import Picture
from yolov5_lifecycle.ros.messages import compressed_image_message, image_message

Transport = Literal["raw", "compressed", "both"]


def raw_message(picture: Picture, encoding: str, header: Header) -> Image:
    """`picture` laid out as `encoding`."""
    return image_message(encoded(picture, encoding), encoding, header)


def jpeg_message(picture: Picture, encoding: str, header: Header) -> CompressedImage:
    """`picture` as a JPEG, which image_transport will unpack to `encoding`."""
    jpeg = encode_jpeg(picture, "mono8" if encoding == "mono8" else "bgr8")
    return compressed_image_message(jpeg, encoding, header)


class ImageForm(NamedTuple):
    """Where below the topic of the images it is published, and what makes the message."""

    suffix: str
    message_type: type
    message: Callable[[Picture, str, Header], Any]


_RAW = ImageForm("", Image, raw_message)
_COMPRESSED = ImageForm("/compressed", CompressedImage, jpeg_message)

IMAGE_FORMS: dict[Transport, list[ImageForm]] = {
    "raw": [_RAW],
    "compressed": [_COMPRESSED],
    "both": [_RAW, _COMPRESSED],
}
