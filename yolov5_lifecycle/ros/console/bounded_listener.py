"""A listening socket that limits the number of open connections."""

from __future__ import annotations

import socket
from typing import Any
from weakref import WeakKeyDictionary

MAX_CONNECTIONS = 128
MAX_CONNECTIONS_OF_ADDRESS = 64
"""Further ones are closed at once."""
UNREAD_S = 5.0
"""A connection whose client takes nothing of what it was sent for so long is ended by the kernel."""


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
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(UNREAD_S * 1000))
        self._address_of[connection] = address
        return connection, place
