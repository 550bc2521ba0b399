"""The WebSocket over which a viewer receives the images of one camera."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress

from rclpy.exceptions import NameValidationException
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.frames import CloseCode

from yolov5_lifecycle.ros.console.budget import Budget
from yolov5_lifecycle.ros.console.detector import Detector
from yolov5_lifecycle.ros.console.image_feed import ImageFeed, ImageFeeds

MAX_VIEWERS = 32
_TAKEN = "taken"
_MESSAGES_PER_S = 120.0
_MESSAGES = 240
_UNKNOWN = 4404


class Viewers:
    """Serves viewers of `feeds`; `find` gives the detector of a name."""

    def __init__(self, feeds: ImageFeeds, find: Callable[[object], Detector | None]) -> None:
        self._feeds = feeds
        self._find = find

    async def serve(self, websocket: WebSocket) -> None:
        """Serve one viewer until it is closed."""
        node = websocket.query_params.get("node", "")
        camera = websocket.query_params.get("camera", "")
        await websocket.accept()
        detector = self._find(node)
        if detector is None or camera not in (detector.camera_names or [""]):
            await websocket.close(_UNKNOWN, "camera not found")
        elif self._feeds.viewers >= MAX_VIEWERS:
            await websocket.close(
                CloseCode.TRY_AGAIN_LATER, f"close a page: the console shows {MAX_VIEWERS} images, the limit"
            )
        else:
            try:
                await _Viewer(websocket, self._feeds.of(node, camera)).serve()
            except NameValidationException:  # no topic can have this name, so no detector has this camera
                await websocket.close(_UNKNOWN, "camera not found")


class _Viewer:
    """One viewer: gets the newest image once it has acknowledged the last, so at most one is in transit."""

    def __init__(self, websocket: WebSocket, feed: ImageFeed) -> None:
        self._websocket = websocket
        self._feed = feed
        self._budget = Budget(_MESSAGES_PER_S, _MESSAGES)
        self._has_taken = True
        self._sent = feed.count
        self._sending: asyncio.Task[None] | None = None

    async def serve(self) -> None:
        if self._feed.newest:
            self._sent -= 1  # the newest image, already sent to other viewers, is new to this one
        try:
            await self._feed.join(self._offer)
            self._offer()
            await self._receive()
        except WebSocketDisconnect:
            pass
        finally:
            await self._feed.leave(self._offer)

    async def _receive(self) -> None:
        while True:
            message = await self._websocket.receive()
            if message["type"] == "websocket.disconnect":
                return
            if message.get("text") != _TAKEN or not self._budget.spend():
                await self._websocket.close(
                    CloseCode.POLICY_VIOLATION, f"expected '{_TAKEN}' after each image"
                )
                return
            self._has_taken = True
            self._offer()

    def _offer(self) -> None:
        """Send the newest image, if the viewer has acknowledged the last one and a newer one has arrived."""
        if self._has_taken and self._feed.count != self._sent and self._feed.newest:
            self._has_taken = False
            self._sent = self._feed.count
            self._sending = asyncio.create_task(self._send(self._feed.newest))

    async def _send(self, payload: bytes) -> None:
        with suppress(WebSocketDisconnect, RuntimeError):  # it is closed; `_receive` ends, too
            await self._websocket.send_bytes(payload)
