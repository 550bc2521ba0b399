"""A camera that misbehaves: `misbehaving_camera.py MANNER IMAGE RATE_HZ TOPIC`.

MANNER is `sending garbage` (images that cannot be read) or `changing size` (with each image).
"""

from __future__ import annotations

import itertools
import sys
import time
from array import array
from collections.abc import Sequence

from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.memory import prepare_heap

if __name__ == "__main__":
    prepare_environment()
    prepare_heap()  # before the imports below start threads

import cv2
import numpy as np
import rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from yolov5_lifecycle.ros.messages import image_message

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
    return [_changed(whole, change) for change in changes]


def images_of_other_sizes(image: str) -> list[Image]:
    """The file `image` in every size."""
    pixels = cv2.imread(image)
    return [_message(cv2.resize(pixels, size_wh)) for size_wh in _SIZES_WH]


def main(manner: str, image: str, rate_hz: float, topic: str) -> None:
    """Publish forever."""
    images = {
        "sending garbage": lambda: unreadable_images(_message(cv2.imread(image))),
        "changing size": lambda: images_of_other_sizes(image),
    }[manner]()
    rclpy.init()
    node = rclpy.create_node("misbehaving_camera")
    publisher = node.create_publisher(Image, topic, QoSProfile(depth=1))
    due_s = time.monotonic()
    for message in itertools.cycle(images):
        time.sleep(max(0.0, due_s - time.monotonic()))
        due_s += 1 / rate_hz
        message.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(message)


def _changed(whole: Image, change: dict[str, object]) -> Image:
    names: Sequence[str] = ("header", "height", "width", "encoding", "step", "data")
    return Image(**{name: getattr(whole, name) for name in names} | change)


def _message(pixels: object) -> Image:
    return image_message(np.asarray(pixels, np.uint8), "bgr8", Header(frame_id="lens"))


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]), sys.argv[4])
