"""The forms in which the camera sends a picture."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import cv2
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header

from yolov5_lifecycle.image_encoding import encoded
from yolov5_lifecycle.images import Picture
from yolov5_lifecycle.ros.messages import image_message

Transport = Literal["raw", "compressed", "both"]


def raw_message(picture: Picture, encoding: str, header: Header) -> Image:
    """`picture` laid out as `encoding`."""
    return image_message(encoded(picture, encoding), encoding, header)


def jpeg_message(picture: Picture, encoding: str, header: Header) -> CompressedImage:
    """`picture` as a JPEG, which image_transport will unpack to `encoding`: that stands in `format`."""
    # image_transport calls the colours of a JPEG bgr8, and has no name for its greys.
    stored, called = ("mono8", "") if encoding == "mono8" else ("bgr8", "bgr8")
    _, data = cv2.imencode(".jpg", encoded(picture, stored))
    message = CompressedImage(header=header, format=f"{encoding}; jpeg compressed {called}")
    # As in image_message: the setter iterates over every byte of anything but an array (ros2/rclpy#836).
    message.data = array("B", data.tobytes())
    return message


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
