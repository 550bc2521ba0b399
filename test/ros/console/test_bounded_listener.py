"""Limits on open connections, with real sockets."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest

from yolov5_lifecycle.ros.console.options import ConsoleOptions
from yolov5_lifecycle.ros.console.web_server import (
    MAX_CONNECTIONS,
    MAX_CONNECTIONS_OF_ADDRESS,
    BoundedListener,
    ListenError,
    listening_socket,
)


class Clients:
    """Connects to a listener from any loopback address; holds both ends of what was accepted."""

    def __init__(self, stack: ExitStack) -> None:
        self._stack = stack
        self._listener = BoundedListener(stack.enter_context(socket.create_server(("127.0.0.1", 0))))
        self._stack.enter_context(self._listener)
        self.accepted: list[socket.socket] = []

    def connect(self, source: str) -> bool:
        """Whether a connection from `source` was accepted."""
        place = self._listener.getsockname()
        self._stack.enter_context(socket.create_connection(place, source_address=(source, 0)))
        with suppress(ConnectionAbortedError):
            connection, (address, _) = self._listener.accept()
            assert address == source
            self.accepted.append(self._stack.enter_context(connection))
            return True
        return False


@pytest.fixture
def clients() -> Iterator[Clients]:
    with ExitStack() as stack:
        yield Clients(stack)


@pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="no IPv6")
@pytest.mark.parametrize("address", ["127.0.0.1", "::1"])
def test_all_addresses_of_ipv6_include_those_of_ipv4(address: str) -> None:
    with (
        listening_socket(ConsoleOptions(host="::", port=0)) as listener,
        socket.create_connection((address, listener.getsockname()[1]), timeout=60),
    ):
        listener.accept()[0].close()


def test_one_address_gets_no_more_than_its_share(clients: Clients) -> None:
    wanted = [clients.connect("127.0.0.1") for _ in range(MAX_CONNECTIONS_OF_ADDRESS + 3)]
    assert wanted == [True] * MAX_CONNECTIONS_OF_ADDRESS + [False] * 3
    assert clients.connect("127.0.0.2")


def test_all_addresses_get_no_more_than_all_may_have(clients: Clients) -> None:
    wanted = [clients.connect(f"127.0.0.{number % 100 + 1}") for number in range(MAX_CONNECTIONS + 1)]
    assert wanted == [True] * MAX_CONNECTIONS + [False]


def test_a_closed_connection_makes_room(clients: Clients) -> None:
    for _ in range(MAX_CONNECTIONS_OF_ADDRESS):
        assert clients.connect("127.0.0.1")
    assert not clients.connect("127.0.0.1")
    clients.accepted[0].close()
    assert clients.connect("127.0.0.1")


@pytest.mark.parametrize(
    "host", ["no such host", "lamp\u202e", f"{'a' * 64}.local"], ids=["gap", "mark", "long"]
)
def test_a_host_that_is_no_name_is_refused_with_what_is_expected(host: str) -> None:
    with pytest.raises(ListenError, match="expected an address or name of this machine, such as"):
        listening_socket(ConsoleOptions(host=host, port=0))
