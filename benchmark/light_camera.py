"""A camera process with as little overhead as a C++ driver.

`light_camera.py IMAGE RATE_HZ TOPIC [MANNER]`: messages are serialized once; only the stamp is written into
their bytes. MANNER is `sending garbage` (images that cannot be read) or `changing size` (with each image).
"""

from __future__ import annotations

import itertools
import struct
import sys
import time
from array import array

from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.memory import prepare_heap

if __name__ == "__main__":
    prepare_environment()
    prepare_heap()  # before the imports below start threads

import cv2
import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from yolov5_lifecycle.ros.messages import image_message

_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
"""Offset of the stamp: an Image follows the serialization header, and starts with its stamp."""
_SIZES_WH = ((640, 480), (480, 640), (640, 360), (600, 600), (800, 250), (300, 900), (1280, 960))
"""Image sizes that each need their own network, more than the detector keeps."""


def unreadable_images(whole: Image) -> list[Image]:
    """`whole` with an unknown encoding, a wrong size or step, or missing bytes."""
    changes: list[dict[str, object]] = [
        {"encoding": "nonsense"},
        {"encoding": "32FC1"},
        {"height": 0},
        {"width": 2**32 - 1},
        {"step": 1},
        {"data": whole.data[: len(whole.data) // 2]},
        {"data": array("B")},
    ]
    names = ("header", "height", "width", "encoding", "step", "data")
    return [Image(**{name: getattr(whole, name) for name in names} | change) for change in changes]


def images_of(pixels: NDArray[np.uint8], manner: str) -> list[Image]:
    """What is sent in turn."""
    if manner == "changing size":
        return [_message(cv2.resize(pixels, size_wh)) for size_wh in _SIZES_WH]
    return unreadable_images(_message(pixels)) if manner == "sending garbage" else [_message(pixels)]


def main(image: str, rate_hz: float, topic: str, manner: str = "") -> None:
    """Publish forever."""
    rclpy.init()
    publisher = rclpy.create_node("light_camera").create_publisher(Image, topic, QoSProfile(depth=1))
    pixels = np.asarray(cv2.imread(image), np.uint8)
    due_s = time.monotonic()
    for data in itertools.cycle(bytearray(serialize_message(each)) for each in images_of(pixels, manner)):
        time.sleep(max(0.0, due_s - time.monotonic()))
        due_s += 1 / rate_hz
        _STAMP.pack_into(data, _STAMP_AT, *divmod(time.time_ns(), 1_000_000_000))
        publisher.publish(bytes(data))


def _message(pixels: object) -> Image:
    return image_message(np.asarray(pixels, np.uint8), "bgr8", Header(frame_id="lens"))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), *sys.argv[3:])
