"""What a client sees of one camera of a served node: its images, their depth, detections and status."""

from __future__ import annotations

from typing import Any

import numpy as np
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray, Detection3DArray

from support.depth_messages import camera_info_message, depth_message
from support.served_node import ServedNode, image
from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.ros.messages import compressed_image_message, image_of_message

SIZE_HW = (48, 64)


class CameraClient:
    """Publishes images of the camera `name`, "" for the only one of a node, as JPEG if `is_compressed`.

    Receives its detections.
    """

    def __init__(
        self,
        served: ServedNode,
        name: str = "",
        *,
        size_hw: tuple[int, int] = SIZE_HW,
        is_compressed: bool = False,
    ) -> None:
        self.served = served
        self.name = name
        self.size_hw = size_hw
        self.sent = 0
        """Images so far, which is the stamp of the last one in seconds."""
        self.detections: list[Detection2DArray] = []
        self._is_compressed = is_compressed
        self._sent_to = set[bytes]()
        if name:
            topic, kind = ("image_raw/compressed", CompressedImage) if is_compressed else ("image_raw", Image)
            self.images = served.client.create_publisher(kind, self.topic(topic), 1)
            served.client.create_subscription(
                Detection2DArray, self.topic("detections"), self.detections.append, 10
            )
        else:
            self.images, self.detections = served.images, served.detections

    def topic(self, name: str) -> str:
        """The full name of one of the camera's topics."""
        return "/".join(filter(None, ("/yolov5", self.name, name)))

    def send(self, message: Image | None = None) -> Header:
        """Send an image; its header."""
        self.sent += 1
        message = message or image(*self.size_hw)
        message.header.stamp.sec = self.sent
        message.header.frame_id = f"{self.name}_optical"
        self._sent_to = self._subscriptions()
        self.images.publish(_compressed(message) if self._is_compressed else message)
        return message.header

    def _subscriptions(self) -> set[bytes]:
        """Which subscriptions get its images; the node makes another to follow the camera's reliability."""
        found = self.served.client.get_subscriptions_info_by_topic(self.images.topic_name)
        return {bytes(subscription.endpoint_gid) for subscription in found}

    def detect(self, message: Image | None = None) -> Detection2DArray:
        """Send images, or the same one again, until one is detected; what was found in the last one sent.

        None of them is waiting or in inference afterwards.
        """
        first_sec = self.sent + 1

        def is_detected(sec: int) -> bool:
            return bool(self.detections) and self.detections[-1].header.stamp.sec >= sec

        self.served.wait_for(
            lambda: bool(self.send(message)) and is_detected(first_sec), f"a detection of {self.name}"
        )

        def is_last_detected() -> bool:
            if self._subscriptions() != self._sent_to:
                self.send(message)
            return is_detected(self.sent)

        self.served.wait_for(is_last_detected, f"the detections of {self.name}")
        return self.detections[-1]

    def see(self, message: Image | None = None) -> Detection2DArray:
        """Send one image to the subscribed node; what was found in it."""
        self.served.wait_for(lambda: bool(self.images.get_subscription_count()), "the node to subscribe")
        return self.detections_of(self.send(message))

    def detections_of(self, header: Header) -> Detection2DArray:
        """The detections with this header."""
        return self.served.received(self.detections, header, f"the detections of {self.name}")

    def track(self) -> str:
        """Send images until the only object in them has an id."""
        self.served.wait_for(lambda: self.detect().detections[0].id != "", f"a track of {self.name}")
        return str(self.detections[-1].detections[0].id)

    def values(self) -> dict[str, str]:
        """The values of the camera's next diagnostic status."""
        return self.served.values(self.name)

    def counts(self) -> dict[str, int]:
        """Frames by what became of them."""
        return self.served.counts(self.name)


class Viewer:
    """Receives images of the kind that the node publishes on a `topic` of `camera`."""

    def __init__(self, camera: CameraClient, topic: str = "image", kind: type = Image) -> None:
        self._camera = camera
        self.received: list[Any] = []
        camera.served.client.create_subscription(kind, camera.topic(topic), self.received.append, 10)

    def begin(self) -> None:
        """Send images until one is answered, as the node may not have discovered the subscriber yet."""
        before = len(self.received)

        def have_come() -> bool:
            self._camera.detect()
            return len(self.received) > before

        self._camera.served.wait_for(have_come, "images")

    def of(self, header: Header) -> Any:
        """The image with this header."""
        return self._camera.served.received(self.received, header, "the image")


class DepthClient(CameraClient):
    """A camera whose depth images show a wall at `wall_m` metres; receives detections in space."""

    def __init__(
        self, served: ServedNode, name: str = "", *, wall_m: float = 2.0, size_hw: tuple[int, int] = SIZE_HW
    ) -> None:
        super().__init__(served, name, size_hw=size_hw)
        self.placed: list[Detection3DArray] = []
        self.depth_m = np.full(size_hw, wall_m, np.float32)
        node, best_effort = served.client, QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.depth = node.create_publisher(Image, self.topic("depth/image_raw"), best_effort)
        self.info = node.create_publisher(CameraInfo, self.topic("depth/camera_info"), 2)
        self.subscription = node.create_subscription(
            Detection3DArray, self.topic("detections_3d"), self.placed.append, 10
        )

    def wait_for_depth(self, count: int = 1) -> None:
        """Wait until so many subscriptions to each of the depth topics are matched."""
        publishers = (self.depth, self.info)
        self.served.wait_for(
            lambda: all(each.get_subscription_count() == count for each in publishers), "the subscriptions"
        )

    def send_depth(self, *, with_info: bool = True) -> None:
        """Send a depth image and its camera_info with the stamp of the next image."""
        height, width = self.size_hw
        info = camera_info_message(self.sent + 1, height=height, width=width)
        message = depth_message(self.depth_m, self.sent + 1)
        for sent in (info, message):
            sent.header.frame_id = f"{self.name}_optical"
        if with_info:
            self.info.publish(info)
        self.depth.publish(message)

    def place(self, *, with_info: bool = True) -> Detection3DArray:
        """Send images with depth until one is placed; what was published in space."""
        first_sec = self.sent + 1

        def is_placed() -> bool:
            # Messages of different topics arrive in any order: perhaps the next one is paired.
            self.send_depth(with_info=with_info)
            self.detect()
            return bool(self.placed) and self.placed[-1].header.stamp.sec >= first_sec

        self.served.wait_for(is_placed, f"detections of {self.name} in space")
        return self.placed[-1]


def _compressed(message: Image) -> CompressedImage:
    jpeg = encode_jpeg(image_of_message(message))
    return compressed_image_message(jpeg, message.encoding, message.header)
