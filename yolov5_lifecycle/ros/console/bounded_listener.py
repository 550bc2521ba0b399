"""A listening socket that limits the number of open connections."""

from __future__ import annotations

import socket
from typing import Any
from weakref import WeakKeyDictionary

MAX_CONNECTIONS = 128
MAX_CONNECTIONS_OF_ADDRESS = 64
"""Further ones are closed at once."""


class BoundedListener(socket.socket):
    """Takes over `listening`; closes excess connections when they are accepted, before any TLS handshake.

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
        self._address_of[connection] = address
        return connection, place
