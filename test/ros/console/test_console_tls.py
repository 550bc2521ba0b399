"""The console with a certificate of its own."""

from __future__ import annotations

import http.client
import shutil
import socket
import ssl
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support.console_process import address, console_process
from support.served_node import PATIENCE_S
from support.worker import worker_domain
from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.typing import Origin
from websockets.uri import parse_uri

from yolov5_lifecycle.ros.console.web_server import MAX_CONNECTIONS_OF_ADDRESS

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")

SHORTER_S = 20.0
"""Less than asyncio waits for the begin of TLS (60 s)."""


@dataclass(frozen=True)
class EncryptedConsole:
    """A console that speaks TLS at `port` of the loopback address; `context` trusts its certificate."""

    port: int
    context: ssl.SSLContext

    def status_of_page(self, source: str = "127.0.0.1") -> int:
        """HTTP status of the page for a client whose address is `source`."""
        connection = http.client.HTTPSConnection(
            "127.0.0.1", self.port, context=self.context, timeout=PATIENCE_S, source_address=(source, 0)
        )
        with closing(connection):
            connection.request("GET", "/")
            return connection.getresponse().status

    def first_message(self) -> str:
        """What the console sends first to a page.

        In one thread, because the blocking client of websockets uses two, in which Python's SSL loses
        requests (python/cpython#76714); without asyncio, because Python 3.10's leaves TLS transports open.
        """
        url, origin = f"wss://127.0.0.1:{self.port}/ws", Origin(f"https://127.0.0.1:{self.port}")
        page = ClientProtocol(parse_uri(url), origin=origin)
        page.send_request(page.connect())
        with (
            socket.create_connection(("127.0.0.1", self.port), timeout=PATIENCE_S) as plain,
            self.context.wrap_socket(plain, server_hostname="127.0.0.1") as connection,
        ):
            for data in page.data_to_send():
                connection.sendall(data)
            while received := connection.recv(4096):
                page.receive_data(received)
                for event in page.events_received():
                    if isinstance(event, Frame) and event.opcode is Opcode.TEXT:
                        return bytes(event.data).decode()
        pytest.fail("the console closed the connection before it sent a message")

    def silent_connection(self, timeout_s: float) -> socket.socket:
        """A connection that has not begun a TLS handshake."""
        return socket.create_connection(("127.0.0.1", self.port), timeout=timeout_s)


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EncryptedConsole]:
    folder = tmp_path_factory.mktemp("certificate")
    certificate, key = folder / "robot.pem", folder / "robot.key"
    create_certificate(certificate, key)
    with (
        worker_domain() as domain,
        console_process(domain, "--cert", str(certificate), "--key", str(key)) as process,
    ):
        url = address(process)
        assert url.startswith("https://")
        context = ssl.create_default_context(cafile=certificate)
        yield EncryptedConsole(urlsplit(url).port or 0, context)
        process.check_running()
        assert "Traceback" not in process.output


def create_certificate(certificate: Path, key: Path) -> None:
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=IP:127.0.0.1"]
    words = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", *names]
    files = ["-keyout", str(key), "-out", str(certificate)]
    subprocess.run([*words, *files], check=True, capture_output=True)


def is_closed(connection: socket.socket) -> bool:
    """Whether the console closes the connection; raises TimeoutError if it sends nothing for too long."""
    with suppress(ConnectionResetError):
        while connection.recv(4096):
            pass
    return True


def test_with_a_certificate_it_speaks_tls(encrypted: EncryptedConsole) -> None:
    assert encrypted.status_of_page() == 200
    assert '"welcome"' in encrypted.first_message()


def test_excess_connections_that_begin_no_tls_are_closed(encrypted: EncryptedConsole) -> None:
    with ExitStack() as stack:
        for _ in range(MAX_CONNECTIONS_OF_ADDRESS):
            stack.enter_context(encrypted.silent_connection(SHORTER_S))
        excess = [stack.enter_context(encrypted.silent_connection(SHORTER_S)) for _ in range(100)]
        assert encrypted.status_of_page("127.0.0.2") == 200
        assert all(map(is_closed, excess))
