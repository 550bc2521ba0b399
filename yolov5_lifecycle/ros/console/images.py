"""Annotated images: subscribed to while there are viewers, and sent to each over a WebSocket."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.exceptions import NameValidationException
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
        return sum(len(feed.viewers) for feed in self._feeds.values())

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one viewer until it is closed."""
        node = websocket.query_params.get("node", "")
        camera = websocket.query_params.get("camera", "")
        await websocket.accept()
        detector = self._find(node)
        if detector is None or camera not in (detector.camera_names or [""]):
            await websocket.close(_UNKNOWN, "camera not found")
            return
        if self.count >= MAX_VIEWERS:
            await websocket.close(
                CloseCode.TRY_AGAIN_LATER, f"close a page: the console shows {MAX_VIEWERS} images, the limit"
            )
            return
        topic = node + of_camera(COMPRESSED_IMAGE, camera).removeprefix("~")
        feed = self._feeds.setdefault(topic, _Feed(self._ros, topic))
        try:
            await _Viewer(websocket, feed).serve()
        except NameValidationException:  # no topic can have this name, so no detector has this camera
            await websocket.close(_UNKNOWN, "camera not found")
        finally:
            if not feed.viewers:
                self._feeds.pop(topic, None)


class _Feed:
    """Subscribes to the compressed images on `topic` while there are viewers; keeps the newest one only."""

    def __init__(self, ros: RosThread, topic: str) -> None:
        self.newest = b""
        """Stamp in seconds as a little-endian float64, then the JPEG; shared by all viewers."""
        self.viewers: set[_Viewer] = set()
        self._ros = ros
        self._topic = topic
        self._mailbox = Mailbox(ros, self._take)
        self._changing = asyncio.Lock()
        self._subscription: Any = None

    async def adapt(self) -> None:
        """Subscribe or end that, as there are viewers or not."""
        async with self._changing:
            if self.viewers and self._subscription is None:
                self._subscription = await self._ros.run(self._subscribe, self._ros.node)
            elif not self.viewers and self._subscription is not None:
                await self._ros.run(self._ros.node.destroy_subscription, self._subscription)
                self._subscription, self.newest = None, b""

    def _subscribe(self, node: Node) -> Any:
        return node.create_subscription(CompressedImage, self._topic, self._receive, QoSProfile(depth=1))

    def _receive(self, message: CompressedImage) -> None:
        if len(message.data) <= _MAX_IMAGE_BYTES:
            stamp = message.header.stamp
            self._mailbox.put(b"".join((_STAMP.pack(stamp.sec + stamp.nanosec * 1e-9), message.data)))

    def _take(self, image: bytes) -> None:
        if self.viewers:
            self.newest = image
            for viewer in self.viewers:
                viewer.offer()


class _Viewer:
    """One viewer: gets the newest image once it has acknowledged the last, so at most one is in transit."""

    def __init__(self, websocket: WebSocket, feed: _Feed) -> None:
        self._websocket = websocket
        self._feed = feed
        self._has_taken = True
        self._sent = b""
        self._sending: asyncio.Task[None] | None = None

    async def serve(self) -> None:
        self._feed.viewers.add(self)
        try:
            await self._feed.adapt()
            self.offer()
            await self._receive()
        except WebSocketDisconnect:
            pass
        finally:
            self._feed.viewers.discard(self)
            await self._feed.adapt()

    async def _receive(self) -> None:
        while (message := await self._websocket.receive())["type"] != "websocket.disconnect":
            if message.get("text") != _TAKEN or self._has_taken:
                await self._websocket.close(
                    CloseCode.POLICY_VIOLATION, f"expected '{_TAKEN}' after each image"
                )
                return
            self._has_taken = True
            self.offer()

    def offer(self) -> None:
        """Send the newest image, if the viewer has acknowledged the last one and a newer one has arrived."""
        if self._has_taken and self._feed.newest and self._feed.newest is not self._sent:
            self._has_taken = False
            self._sent = self._feed.newest
            self._sending = asyncio.create_task(self._send(self._sent))

    async def _send(self, payload: bytes) -> None:
        with suppress(WebSocketDisconnect, RuntimeError):  # it is closed; `_receive` ends, too
            await self._websocket.send_bytes(payload)
