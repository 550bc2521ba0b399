"""Open WebSockets when their session expires, driven as the web server drives them."""

from __future__ import annotations

import asyncio

import pytest
from rclpy.logging import get_logger
from starlette.types import Message, Scope

from yolov5_lifecycle.ros.console.application import WebApplication
from yolov5_lifecycle.ros.console.gate import Addresses, Gate
from yolov5_lifecycle.ros.console.pages import Pages
from yolov5_lifecycle.ros.console.sessions import SESSION_S, Sessions

COOKIE = "console_8080"
PATIENCE_S = 60.0


class Socket:
    """A WebSocket of a browser that says nothing and stays open."""

    def __init__(self) -> None:
        self.sent: list[Message] = []
        self._is_connected = False

    async def receive(self) -> Message:
        if self._is_connected:
            await asyncio.Event().wait()
        self._is_connected = True
        return {"type": "websocket.connect"}

    async def send(self, message: Message) -> None:
        self.sent.append(message)


def upgrade(path: str, cookie: str) -> Scope:
    headers = {"host": "127.0.0.1:8080", "origin": "http://127.0.0.1:8080", "cookie": cookie}
    return {
        "type": "websocket",
        "path": path,
        "raw_path": path.encode(),
        "query_string": b"",
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
        "server": ("127.0.0.1", 8080),
        "client": ("127.0.0.1", 50_000),
        "state": {},
    }


@pytest.mark.parametrize("path", ["/ws", "/image"])
def test_an_open_socket_is_closed_when_its_session_expires(path: str) -> None:
    now_s = 0.0
    sessions = Sessions("t" * 43, clock=lambda: now_s)
    cookie = f"{COOKIE}={sessions.begin()}"
    now_s = SESSION_S - 0.01
    pages = Pages(lambda name: None, list, view_only=False)
    application = WebApplication(
        page=pages.serve,
        image=pages.serve,
        sessions=sessions,
        figures=None,
        logger=get_logger("console"),
    )
    gate = Gate(application, Addresses(scheme="http", is_loopback=True), sessions, port=8080)
    browser = Socket()
    asyncio.run(asyncio.wait_for(gate(upgrade(path, cookie), browser.receive, browser.send), PATIENCE_S))
    accepted, *_, closed = browser.sent
    assert accepted["type"] == "websocket.accept"
    assert (closed["type"], closed["code"]) == ("websocket.close", 4401)
    assert pages.count == 0
