"""A client of a served node with depth: a colour and a depth camera, and what is published in space."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection2DArray, Detection3DArray

from support.depth_messages import camera_info_message, depth_message, header, prediction_of
from support.depth_scene import CAMERA, DepthScene, random_depth_scene
from support.preparations import Preparations
from support.served_node import ServedNode, image

PADDING_Y = 8  # a network input of 320 x 256 for images of 320 x 240
DEPTH_ON = ("image_size:=320", "depth:=true", "depth_slop_s:=0.05")
ANSWER_S = 10.0  # the first image after another subscription may be lost
SCENE = random_depth_scene(np.random.default_rng(5), "board")


class DepthClient:
    """A colour and a depth camera, and a subscriber to `~/detections_3d`."""

    def __init__(self, served: ServedNode, prepare: Preparations) -> None:
        self.served = served
        self._prepare = prepare
        self.received: list[Detection3DArray] = []
        client = served.client
        best_effort = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.depth = client.create_publisher(Image, "/yolov5/depth/image_raw", best_effort)
        self.info = client.create_publisher(CameraInfo, "/yolov5/depth/camera_info", 2)
        self.subscription = client.create_subscription(
            Detection3DArray, "/yolov5/detections_3d", self.received.append, 10
        )
        self._stamp_s = 100.0

    def begin(self) -> None:
        self.served.bring_to("active")
        self.show(SCENE)
        self.wait_for_depth()

    def wait_for_depth(self, count: int = 1) -> None:
        publishers = (self.depth, self.info)
        self.served.wait_for(
            lambda: all(one.get_subscription_count() == count for one in publishers), "the subscriptions"
        )

    def show(self, scene: DepthScene) -> None:
        """The model detects the object of `scene` from now on."""
        rows = prediction_of([scene.box_xyxy], padding_y=PADDING_Y)
        self._prepare.running.run = lambda: rows

    def next_stamp_s(self) -> float:
        self._stamp_s += 1.0
        return self._stamp_s

    def values_until(self, condition: Callable[[dict[str, str]], bool], what: str) -> dict[str, str]:
        """The diagnostics once they fulfil `condition`."""
        last: dict[str, str] = {}

        def is_met() -> bool:
            last.clear()
            last.update(self.served.values())
            return condition(last)

        self.served.wait_for(is_met, what)
        return last

    def send(self, depth: Image | None, info: CameraInfo | None) -> None:
        """Send messages of the depth camera and wait until the node has them."""
        before = self.served.values()
        if info is not None:
            self.info.publish(info)
        if depth is not None:
            self.depth.publish(depth)
            expected = int(before["depth images received"]) + 1
            self.values_until(lambda now: int(now["depth images received"]) == expected, "the depth image")

    def detect(self, stamp_s: float, *, size_hw: tuple[int, int] = CAMERA.size_hw) -> int:
        """Send a colour image until its detections in 2D are there; their number."""
        message = image(*size_hw)
        message.header = header(stamp_s)
        message.header.frame_id = "colour"
        begun, sent_s = len(self.served.detections), float("-inf")

        def answers() -> list[Detection2DArray]:
            return [array for array in self.served.detections[begun:] if array.header == message.header]

        def is_answered() -> bool:
            nonlocal sent_s
            if time.monotonic() - sent_s > ANSWER_S:
                self.served.publish(message)
                sent_s = time.monotonic()
            return bool(answers())

        self.served.wait_for(is_answered, "the detections")
        return len(answers()[0].detections)

    def place(
        self, scene: DepthScene = SCENE, *, encoding: str = "16UC1", with_info: bool = True
    ) -> Detection3DArray:
        """Send depth and colour images until one is placed; what was published in space."""
        first = header(self._stamp_s).stamp.sec

        def placed() -> list[Detection3DArray]:
            return [array for array in self.received if array.header.stamp.sec > first]

        def is_placed() -> bool:
            stamp_s = self.next_stamp_s()
            if with_info:
                self.info.publish(camera_info_message(stamp_s))
            self.depth.publish(depth_message(scene.depth_m, stamp_s, encoding=encoding))
            # Messages of different topics arrive in any order: perhaps the next one is paired.
            self.detect(stamp_s)
            return bool(placed())

        self.served.wait_for(is_placed, "detections in space")
        return placed()[0]
