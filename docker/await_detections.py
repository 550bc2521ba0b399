"""Waits two minutes at most until /yolov5/detections has had all given classes. For docker/try-image."""

from __future__ import annotations

import sys
import time

import rclpy
from vision_msgs.msg import Detection2DArray

LIMIT_S = 120.0


def main(wanted: set[str]) -> int:
    """Exit status: 0 when all classes of `wanted` were detected, else 1."""
    rclpy.init()
    node = rclpy.create_node("await_detections")
    messages: list[Detection2DArray] = []
    node.create_subscription(Detection2DArray, "/yolov5/detections", messages.append, 10)
    end = time.monotonic() + LIMIT_S
    found: set[str] = set()
    while not wanted <= found and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=1.0)
        found = {each.results[0].hypothesis.class_id for message in messages for each in message.detections}
    sys.stdout.write(f"{len(messages)} messages, with {', '.join(sorted(found)) or 'no detections'}\n")
    rclpy.shutdown()
    return 0 if wanted <= found else 1


if __name__ == "__main__":
    sys.exit(main(set(sys.argv[1:])))
