"""Annotated images: subscribed to while there are viewers, and sent to each over a WebSocket."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.frames import CloseCode

from yolov5_lifecycle.ros.console.detector import Detector
from yolov5_lifecycle.ros.console.ros_thread import Mailbox, RosThread
from yolov5_lifecycle.ros.topics import COMPRESSED_IMAGE, of_camera

MAX_VIEWERS = 32
_MAX_IMAGE_BYTES = 64 * 1024 * 1024
"""Larger ones are not shown; the largest image that a detector accepts has 67 million pixels."""
_STAMP = struct.Struct("<d")
_TAKEN = "taken"
_UNKNOWN = 4404


class Viewers:
    """Serves the images of cameras; `find` gives the detector of a name."""

    def __init__(self, ros: RosThread, find: Callable[[object], Detector | None]) -> None:
        self._ros = ros
        self._find = find
        self._feeds: dict[str, _Feed] = {}

    @property
    def count(self) -> int:
        """How many images are shown now."""
        return sum(feed.viewers for feed in self._feeds.values())

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one viewer until it is closed."""
        node = websocket.query_params.get("node", "")
        camera = websocket.query_params.get("camera", "")
        await websocket.accept()
        detector = self._find(node)
        if detector is None or camera not in detector.cameras:
            await websocket.close(_UNKNOWN, "camera not found")
            return
        if self.count >= MAX_VIEWERS:
            await websocket.close(
                CloseCode.TRY_AGAIN_LATER, f"close a page: the console shows {MAX_VIEWERS} images, the limit"
            )
            return
        topic = node + of_camera(COMPRESSED_IMAGE, camera).removeprefix("~")
        feed = self._feeds.setdefault(topic, _Feed(self._ros, topic))
        feed.begin()
        try:
            await _show(websocket, feed)
        finally:
            feed.end()
            if not feed.viewers:
                del self._feeds[topic]


class _Feed:
    """Subscribes to the compressed images on `topic` while there are `viewers`; keeps the newest one only."""

    def __init__(self, ros: RosThread, topic: str) -> None:
        self.viewers = 0
        self._newest = b""
        self._arrived = asyncio.Event()
        self._ros = ros
        self._topic = topic
        self._mailbox = Mailbox(ros, self._take)
        self._subscription: Any = None

    def begin(self) -> None:
        self.viewers += 1
        if self.viewers == 1:
            self._ros.run(self._subscribe, self._ros.node)

    def end(self) -> None:
        self.viewers -= 1
        if self.viewers == 0:
            self._ros.run(lambda: self._ros.node.destroy_subscription(self._subscription))

    async def after(self, last: bytes) -> bytes:
        """The newest image once it is another than `last`; the same for all viewers.

        Its stamp in seconds as a little-endian float64, then the JPEG.
        """
        while not self._newest or self._newest is last:
            await self._arrived.wait()
        return self._newest

    def _subscribe(self, node: Node) -> None:
        quality = QoSProfile(depth=1)
        self._subscription = node.create_subscription(CompressedImage, self._topic, self._receive, quality)

    def _receive(self, message: CompressedImage) -> None:
        if len(message.data) <= _MAX_IMAGE_BYTES:
            stamp = message.header.stamp
            self._mailbox.put(b"".join((_STAMP.pack(stamp.sec + stamp.nanosec * 1e-9), message.data)))

    def _take(self, image: bytes) -> None:
        self._newest = image
        self._arrived.set()
        self._arrived = asyncio.Event()


async def _show(websocket: WebSocket, feed: _Feed) -> None:
    """Send the newest image whenever the last one was acknowledged, so at most one is in transit."""
    has_taken = asyncio.Event()
    has_taken.set()
    sending = asyncio.create_task(_send_images(websocket, feed, has_taken))
    try:
        while (message := await websocket.receive())["type"] != "websocket.disconnect":
            if message.get("text") != _TAKEN or has_taken.is_set():
                with suppress(WebSocketDisconnect, RuntimeError):  # it is gone
                    await websocket.close(CloseCode.POLICY_VIOLATION, f"expected '{_TAKEN}' after each image")
                return
            has_taken.set()
    finally:
        sending.cancel()


async def _send_images(websocket: WebSocket, feed: _Feed, has_taken: asyncio.Event) -> None:
    image = b""
    with suppress(WebSocketDisconnect, RuntimeError):  # it is closed, which `_show` is told, too
        while await has_taken.wait():
            image = await feed.after(image)
            has_taken.clear()
            await websocket.send_bytes(image)
