"""The HTTP server: its socket, limits and headers."""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Iterator
from typing import Any
from weakref import WeakKeyDictionary

import h11
import uvicorn
import websockets.http11
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode, Frame

from yolov5_lifecycle.ros.console.gate import MAX_HEADER_BYTES
from yolov5_lifecycle.ros.console.options import ConsoleOptions

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; form-action 'none'; frame-ancestors 'none'; base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
"""Of every response."""
MAX_CONNECTIONS, MAX_CONNECTIONS_OF_ADDRESS = 128, 64
"""Further ones are closed at once."""
MAX_FRAGMENTS = 1024
"""Of a message; one without data costs memory, too."""
_MAX_BUSY_CONNECTIONS = 96
"""With more connections, requests are answered with 503."""
_MAX_MESSAGE_BYTES = 256 * 1024
"""Of a page to the console; the longest list of class names fits."""
_MAX_UNREAD_BYTES = 1 << 20
"""With more to send to a client, its pings are not answered."""
_REQUEST_S = 5.0
"""A connection that has sent no complete request by then is closed."""
_UNREAD_S = 5.0
"""A connection whose client takes nothing of what it was sent for so long is ended by the kernel."""
_PING_S, _PONG_S = 5.0, 15.0
"""A page or viewer that does not answer a ping is closed; on a slow link, the ping comes after an image."""
_END_S = 1
_BACKLOG = 64
_UNREADABLE = b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"


class WebServer(uvicorn.Server):
    """Serves `application` until `should_exit` is set; leaves signals alone.

    Raises OSError with the remedy if the certificate of `options` cannot be used.
    """

    def __init__(self, application: ASGIApp, options: ConsoleOptions) -> None:
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
            ws_max_size=_MAX_MESSAGE_BYTES,
            ws_ping_interval=_PING_S,
            ws_ping_timeout=_PONG_S,
            ws_per_message_deflate=False,
            limit_concurrency=_MAX_BUSY_CONNECTIONS,
            h11_max_incomplete_event_size=MAX_HEADER_BYTES,
            timeout_graceful_shutdown=_END_S,
            ssl_certfile=options.certificate,
            ssl_keyfile=options.key,
        )
        # The cookies of other programs on this host may be longer than the 8 KiB of websockets.
        websockets.http11.MAX_LINE_LENGTH = MAX_HEADER_BYTES
        try:
            config.load()
        except OSError as error:
            raise OSError(
                f"--cert {options.certificate} and --key {options.key} cannot be used: {error}. Expected a "
                "certificate chain and its private key, both PEM, the key without a password."
            ) from error
        super().__init__(config)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """The process handles them."""
        yield


class _PromptProtocol(H11Protocol):
    """Closes connections that send no complete request for too long.

    uvicorn has no timer for the first request, and stops that for the next one with its first byte.
    """

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._close_unless_prompt()

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._close_unless_prompt()

    def _close_unless_prompt(self) -> None:
        if self.conn.our_state is h11.IDLE:
            self.loop.call_later(_REQUEST_S, self._close_if_idle)

    def _close_if_idle(self) -> None:
        is_idle = self.conn.our_state is h11.IDLE and self in self.connections
        if is_idle and not self.transport.is_closing():
            self.transport.close()


class _BoundedWebSocket(WebSocketsSansIOProtocol):
    """Bounds what uvicorn keeps for a client: fragments of a message, and pongs that it does not read.

    Answers an upgrade that websockets cannot read, such as one with very many headers: uvicorn waits for the
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


class BoundedListener(socket.socket):
    """Takes over `listening`; closes excess connections when they are accepted, before any TLS handshake,
    and those whose clients read nothing.

    asyncio calls a protocol's `connection_made` only after the handshake, so a limit there would not apply to
    connections that never begin one.
    """

    def __init__(self, listening: socket.socket) -> None:
        super().__init__(fileno=listening.detach())
        self._address_of: WeakKeyDictionary[socket.socket, str] = WeakKeyDictionary()

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection and its address; raises ConnectionAbortedError for an excess one."""
        connection, place = super().accept()
        address = str(place[0])
        addresses = [other for known, other in self._address_of.items() if known.fileno() >= 0]
        if len(addresses) >= MAX_CONNECTIONS or addresses.count(address) >= MAX_CONNECTIONS_OF_ADDRESS:
            connection.close()
            # asyncio goes on with the next one.
            raise ConnectionAbortedError(f"{address} has too many connections")
        # Closing alone would not do: asyncio keeps a closed connection until its buffer is empty.
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(_UNREAD_S * 1000))
        self._address_of[connection] = address
        return connection, place


def listening_socket(options: ConsoleOptions) -> BoundedListener:
    """Listens on the address of `options`. Raises OSError, whose message has the cause and a remedy."""
    try:
        family, _, _, _, address = socket.getaddrinfo(
            options.host, options.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        is_dual = family == socket.AF_INET6 and address[0] == "::" and socket.has_dualstack_ipv6()
        return BoundedListener(
            socket.create_server(address[:2], family=family, backlog=_BACKLOG, dualstack_ipv6=is_dual)
        )
    except (socket.gaierror, UnicodeError):  # the latter for what no name in the DNS can contain
        raise OSError(
            f"--host {options.host}: expected an address or name of this machine, such as 0.0.0.0 for all"
        ) from None
    except OSError as error:
        raise OSError(_listen_problem(options, error)) from error


def _listen_problem(options: ConsoleOptions, error: OSError) -> str:
    place = f"port {options.port} of {options.host}"
    if error.errno == errno.EADDRINUSE:
        return f"{place} is in use, perhaps by another console: choose another with --port, or stop that one"
    if error.errno == errno.EACCES:
        return f"{place} requires root: choose one above 1023 with --port"
    if error.errno == errno.EADDRNOTAVAIL:
        return f"--host {options.host} is not an address of this machine; 0.0.0.0 stands for all of them"
    return f"{place} cannot be used: {error.strerror}"
