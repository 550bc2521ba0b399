"""What a client of the console can make it keep, with frames as no browser sends them."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

import pytest
from starlette.types import Receive, Scope, Send

from yolov5_lifecycle.ros.console.options import ConsoleOptions
from yolov5_lifecycle.ros.console.web_server import MAX_FRAGMENTS, WebServer, listening_socket

UPGRADE = (
    b"GET /ws HTTP/1.1\r\nHost: robot\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)
MASK = b"\0\0\0\0"
BEGIN, MORE, END = (head + b"\x80" + MASK for head in (b"\x01", b"\x00", b"\x80"))
PING = b"\x89\xfd" + MASK + b"x" * 125
PINGS = 24_000
PATIENCE_S = 10


@dataclass(frozen=True)
class Client:
    """A connection to `server`; `heard` is set once a whole message of it has arrived."""

    server: WebServer
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    heard: asyncio.Event

    @property
    def unread_bytes(self) -> int:
        """What the server keeps to be sent to the client."""
        (connection,) = self.server.server_state.connections
        return int(connection.transport.get_write_buffer_size())


@asynccontextmanager
async def connected() -> AsyncIterator[Client]:
    heard = asyncio.Event()

    async def listen(_: Scope, receive: Receive, send: Send) -> None:
        await send({"type": "websocket.accept"})
        while (message := await receive())["type"] != "websocket.disconnect":
            if message["type"] == "websocket.receive":
                heard.set()

    options = ConsoleOptions(port=0)
    sock = listening_socket(options)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 14)  # as its connections will have
    port = sock.getsockname()[1]
    server = WebServer(listen, options)
    serving = asyncio.create_task(server.serve([sock]))
    reader, writer = await asyncio.open_connection("127.0.0.1", port, limit=1 << 12)
    try:
        writer.write(UPGRADE)
        await reader.readuntil(b"\r\n\r\n")
        yield Client(server, reader, writer, heard)
    finally:
        writer.transport.abort()
        server.should_exit = True
        await serving


def asked(do: Callable[[Client], Awaitable[object]]) -> object:
    """What `do` returns of a new connection, within PATIENCE_S."""

    async def run() -> object:
        async with connected() as client:
            return await asyncio.wait_for(do(client), PATIENCE_S)

    return asyncio.run(run())


def test_a_message_of_many_fragments_is_heard() -> None:
    async def send(client: Client) -> bool:
        client.writer.write(BEGIN + MORE * (MAX_FRAGMENTS - 2) + END)
        return await client.heard.wait()

    assert asked(send)


@pytest.mark.parametrize("sent", [1, 5000], ids=["one too many", "thousands too many"])
def test_a_message_that_does_not_end_closes_its_connection(sent: int) -> None:
    async def send(client: Client) -> bytes:
        client.writer.write(BEGIN + MORE * (MAX_FRAGMENTS - 1 + sent))
        return await client.reader.read()

    answer = asked(send)
    assert isinstance(answer, bytes)
    assert answer.endswith(b"more than %d fragments of a message" % MAX_FRAGMENTS)


def test_pings_of_a_client_that_reads_no_pongs_are_not_kept() -> None:
    async def send(client: Client) -> int:
        client.writer.write(PING * PINGS + BEGIN + END)
        await client.heard.wait()
        return client.unread_bytes

    unread_bytes = asked(send)
    assert isinstance(unread_bytes, int)
    assert unread_bytes < len(PING) * PINGS / 2
