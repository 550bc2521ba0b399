"""The WebSocket of a page, driven as the web server drives it."""

from __future__ import annotations

import asyncio
import json

from starlette.types import Message
from starlette.websockets import WebSocket

from yolov5_lifecycle.ros.console.pages import Pages

AT_ONCE, REQUESTS_PER_S = 50, 25
"""Fewer than a page may send."""


class DeafPage:
    """Sends a request whenever it is asked for one; never takes the second text of the server."""

    def __init__(self) -> None:
        self.requests = 0
        self.closed: Message | None = None
        self._texts = 0
        self._is_connected = False

    async def receive(self) -> Message:
        if not self._is_connected:
            self._is_connected = True
            return {"type": "websocket.connect"}
        await asyncio.sleep(0 if self.requests < AT_ONCE else 1 / REQUESTS_PER_S)
        self.requests += 1
        return {"type": "websocket.receive", "text": json.dumps({"id": self.requests, "type": "none"})}

    async def send(self, message: Message) -> None:
        if message["type"] == "websocket.close":
            self.closed = message
        elif message["type"] == "websocket.send":
            self._texts += 1
            if self._texts > 1:
                await asyncio.Event().wait()


def test_a_page_that_reads_no_answers_is_closed() -> None:
    page = DeafPage()
    pages = Pages(lambda name: None, list, view_only=False)
    websocket = WebSocket({"type": "websocket"}, page.receive, page.send)
    asyncio.run(asyncio.wait_for(pages.serve(websocket), 60))
    assert page.closed is not None
    assert page.closed["reason"] == "this page does not read answers"
    assert pages.count == 0
