"""The HTTP server: its socket, limits and headers."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
import ssl
import sys
from collections.abc import Iterator
from typing import Any

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode, Frame

from yolov5_lifecycle.ros.console.bounded_listener import BoundedListener
from yolov5_lifecycle.ros.console.cookies import of_consoles
from yolov5_lifecycle.ros.console.gate import MAX_HEADER_BYTES
from yolov5_lifecycle.ros.console.options import ConsoleOptions

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; form-action 'self'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    # Not no-referrer: with it, browsers send the login form with `Origin: null`.
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Of every response."""
MAX_BUSY_CONNECTIONS = 96
"""With more connections, requests are answered with 503."""
FIRST_REQUEST_S = 5.0
"""A connection that has finished no TLS handshake, or sent no complete request, by then is closed."""
MAX_MESSAGE_BYTES = 256 * 1024
"""Of a page to the console; the longest list of class names fits."""
MAX_FRAGMENTS = 1024
"""Of a message; one without data costs memory, too."""
_MAX_UNREAD_BYTES = 1 << 20
"""With more to send to a client, its pings are not answered."""
_UNREADABLE = b"\r\n".join(
    [
        b"HTTP/1.1 400 Bad Request",
        b"Connection: close",
        b"Content-Length: 0",
        *(f"{name}: {value}".encode() for name, value in HEADERS.items()),
        b"\r\n",
    ]
)
_PING_S, _PONG_S = 5.0, 15.0
"""A page or viewer that does not answer a ping is closed; on a slow link, the ping comes after an image."""
_END_S = 1
_BACKLOG = 64
_TLS_LIMITS: dict[str, Any] = {"ssl_handshake_timeout": FIRST_REQUEST_S}
if sys.version_info >= (3, 11):
    # Or else a client that does not answer the end of TLS keeps its connection for half a minute.
    _TLS_LIMITS["ssl_shutdown_timeout"] = FIRST_REQUEST_S


class ListenError(Exception):
    """The server cannot start; the message has the cause and a remedy."""


class WebServer(uvicorn.Server):
    """Serves `application` on `sock` until `should_exit` is set; leaves signals alone."""

    def __init__(self, application: ASGIApp, options: ConsoleOptions, sock: socket.socket) -> None:
        config = uvicorn.Config(
            application,
            http=_PromptProtocol,
            ws=_BoundedWebSocket,
            lifespan="off",
            log_config=None,
            # Errors of clients are answered, not logged; the application logs its own errors.
            log_level="critical",
            access_log=False,
            proxy_headers=False,
            server_header=False,
            headers=list(HEADERS.items()),
            ws_max_size=MAX_MESSAGE_BYTES,
            ws_ping_interval=_PING_S,
            ws_ping_timeout=_PONG_S,
            ws_per_message_deflate=False,
            limit_concurrency=MAX_BUSY_CONNECTIONS,
            h11_max_incomplete_event_size=MAX_HEADER_BYTES,
            timeout_graceful_shutdown=_END_S,
            ssl_certfile=options.certificate,
            ssl_keyfile=options.key,
        )
        try:
            config.load()
        except (OSError, ssl.SSLError) as error:
            raise ListenError(
                f"--cert {options.certificate} and --key {options.key} cannot be used: {error}. Expected a "
                "certificate chain and its private key, both PEM, the key without a password."
            ) from error
        super().__init__(config)
        self._sock = sock

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """The process handles them."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, as uvicorn does, but limit the time that TLS takes, for which it has no option."""
        await self.lifespan.startup()
        server = await asyncio.get_running_loop().create_server(
            self._protocol,
            sock=self._sock,
            ssl=self.config.ssl,
            backlog=self.config.backlog,
            **(_TLS_LIMITS if self.config.ssl else {}),
        )
        self.servers = [server]
        self.started = True

    def _protocol(self) -> asyncio.Protocol:
        return _PromptProtocol(self.config, self.server_state, self.lifespan.state)

    async def serve_until_exit(self) -> None:
        await self.serve([self._sock])


class _PromptProtocol(H11Protocol):
    """Closes connections that send no complete request for too long."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.loop.call_later(FIRST_REQUEST_S, self._close_if_idle)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        # uvicorn stops its timer with the first byte of the next request, which may never be complete.
        if self.conn.our_state is h11.IDLE:
            self.loop.call_later(FIRST_REQUEST_S, self._close_if_idle)

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        # websockets refuses a header of more than 8 KiB, and the cookies of other programs may be longer.
        self.headers = [
            (name, of_consoles(value.decode("latin-1")).encode("latin-1") if name == b"cookie" else value)
            for name, value in self.headers
        ]
        super().handle_websocket_upgrade(event)

    def _close_if_idle(self) -> None:
        is_idle = self.conn.our_state is h11.IDLE and self in self.connections
        if is_idle and not self.transport.is_closing():
            self.transport.close()


class _BoundedWebSocket(WebSocketsSansIOProtocol):
    """Bounds what uvicorn keeps for a client: fragments of a message, and pongs that it does not read.

    Answers an upgrade that websockets cannot read, such as one with a very long header: uvicorn waits for the
    event of such a request, which does not come, and leaves the connection open.
    """

    _fragments = 1  # of the message that has not ended

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.conn.handshake_exc is not None and not self.handshake_initiated:
            self.transport.write(_UNREADABLE)
            self.transport.close()

    def handle_cont(self, event: Frame) -> None:
        self._fragments = 1 if event.fin else self._fragments + 1
        if self._fragments <= MAX_FRAGMENTS:
            super().handle_cont(event)
        elif not self.close_sent:
            self.conn.fail(CloseCode.MESSAGE_TOO_BIG, f"more than {MAX_FRAGMENTS} fragments of a message")
            self.handle_parser_exception()

    def handle_ping(self) -> None:
        if self.transport.get_write_buffer_size() <= _MAX_UNREAD_BYTES:
            super().handle_ping()
        else:
            self.conn.data_to_send()  # the pong, which is not sent


def listening_socket(options: ConsoleOptions) -> BoundedListener:
    """Listens on the address of `options`. Raises ListenError."""
    try:
        family, _, _, _, address = socket.getaddrinfo(
            options.host, options.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        is_dual = family == socket.AF_INET6 and address[0] == "::" and socket.has_dualstack_ipv6()
        return BoundedListener(
            socket.create_server(address[:2], family=family, backlog=_BACKLOG, dualstack_ipv6=is_dual)
        )
    except (socket.gaierror, UnicodeError):  # the latter for what no name in the DNS can contain
        raise ListenError(
            f"--host {options.host}: expected an address or name of this machine, such as 0.0.0.0 for all"
        ) from None
    except OSError as error:
        raise ListenError(_listen_problem(options, error)) from error


def _listen_problem(options: ConsoleOptions, error: OSError) -> str:
    place = f"port {options.port} of {options.host}"
    if error.errno == errno.EADDRINUSE:
        return f"{place} is in use, perhaps by another console: choose another with --port, or stop that one"
    if error.errno == errno.EACCES:
        return f"{place} requires root: choose one above 1023 with --port"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"--host {options.host} is not an address of this machine; 0.0.0.0 stands for all of them"
    return f"{place} cannot be used: {error.strerror}"


def url_of(sock: socket.socket, scheme: str) -> str:
    """Address of the page; with 0.0.0.0, under the name of this machine."""
    address, port = sock.getsockname()[:2]
    if address in ("0.0.0.0", "::"):
        address = socket.gethostname()
    host = f"[{address}]" if ":" in address else address
    return f"{scheme}://{host}:{port}/"
