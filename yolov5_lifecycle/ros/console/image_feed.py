"""The newest annotated image of each camera with viewers."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage

from yolov5_lifecycle.ros.console.ros_thread import RosThread
from yolov5_lifecycle.ros.topics import COMPRESSED_IMAGE, of_camera

_NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
_STAMP = struct.Struct("<d")
_MAX_IMAGE_BYTES = 64 * 1024 * 1024
"""Larger ones are not shown; the largest image that a detector accepts has 67 million pixels."""
_MAX_IDLE = 100
"""Feeds without viewers."""

Wake = Callable[[], object]


class ImageFeed:
    """Subscribes to the compressed images on `topic` while there are viewers; keeps the newest one only.

    Used in the thread of the event loop.
    """

    def __init__(self, ros: RosThread, topic: str) -> None:
        self.newest = b""
        """Stamp in seconds as a little-endian float64, then the JPEG; shared by all viewers."""
        self.count = 0
        """Images so far."""
        self._ros = ros
        self._topic = topic
        self._viewers: set[Wake] = set()
        self._changing = asyncio.Lock()
        self._subscription: Any = None
        self._received = b""
        self._is_announced = False

    @property
    def viewers(self) -> int:
        return len(self._viewers)

    async def join(self, wake: Wake) -> None:
        """Call `wake()` after each image from now on."""
        self._viewers.add(wake)
        await self._adapt()

    async def leave(self, wake: Wake) -> None:
        """Stop calling `wake`; the last viewer to leave ends the subscription."""
        self._viewers.discard(wake)
        await self._adapt()

    async def _adapt(self) -> None:
        async with self._changing:
            if self._viewers and self._subscription is None:
                self._subscription = await self._ros.run(self._subscribe, self._ros.node)
            elif not self._viewers and self._subscription is not None:
                await self._ros.run(self._ros.node.destroy_subscription, self._subscription)
                self._subscription, self.newest = None, b""

    def _subscribe(self, node: Node) -> Any:
        return node.create_subscription(CompressedImage, self._topic, self._receive, _NEWEST)

    def _receive(self, message: CompressedImage) -> None:
        """In the ROS thread: announce the image, unless the previous one has not been fetched yet."""
        if len(message.data) > _MAX_IMAGE_BYTES:
            return
        stamp = message.header.stamp
        self._received = b"".join((_STAMP.pack(stamp.sec + stamp.nanosec * 1e-9), message.data))
        if not self._is_announced:
            self._is_announced = True
            self._ros.post(self._fetch)

    def _fetch(self) -> None:
        self._is_announced = False  # before the image is fetched, so that one that arrives now is announced
        if self._viewers:
            self.newest = self._received
            self.count += 1
            for wake in list(self._viewers):
                wake()


class ImageFeeds:
    """The feeds of all cameras of all detectors."""

    def __init__(self, ros: RosThread) -> None:
        self._ros = ros
        self._feeds: dict[tuple[str, str], ImageFeed] = {}

    def of(self, node: str, camera: str) -> ImageFeed:
        """The feed of a camera; `node` is a full name."""
        if (node, camera) not in self._feeds:
            if len(self._feeds) > _MAX_IDLE:
                self._feeds = {place: feed for place, feed in self._feeds.items() if feed.viewers}
            topic = node + of_camera(COMPRESSED_IMAGE, camera).removeprefix("~")
            self._feeds[node, camera] = ImageFeed(self._ros, topic)
        return self._feeds[node, camera]

    @property
    def viewers(self) -> int:
        return sum(feed.viewers for feed in self._feeds.values())
