"""A camera process with as little overhead as a C++ driver.

`light_camera.py IMAGE RATE_HZ TOPIC`: the message is serialized once; only the stamp is written into it.
"""

from __future__ import annotations

import struct
import sys
import time

from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.memory import prepare_heap

if __name__ == "__main__":
    prepare_environment()
    prepare_heap()  # before the imports below start threads

import cv2
import numpy as np
import rclpy
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from yolov5_lifecycle.ros.messages import image_message

_STAMP = struct.Struct("<iI")
_STAMP_AT = 4
"""Offset of the stamp: an Image follows the serialization header, and starts with its stamp."""


def main(image: str, rate_hz: float, topic: str) -> None:
    """Publish forever."""
    rclpy.init()
    publisher = rclpy.create_node("light_camera").create_publisher(Image, topic, QoSProfile(depth=1))
    pixels = np.asarray(cv2.imread(image), np.uint8)
    data = bytearray(serialize_message(image_message(pixels, "bgr8", Header(frame_id="lens"))))
    due_s = time.monotonic()
    while True:
        time.sleep(max(0.0, due_s - time.monotonic()))
        due_s += 1 / rate_hz
        _STAMP.pack_into(data, _STAMP_AT, *divmod(time.time_ns(), 1_000_000_000))
        publisher.publish(bytes(data))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), sys.argv[3])
