"""Hostile requests to the console, from clients without its token."""

from __future__ import annotations

import json
import random
import socket
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rcl_interfaces.msg import ParameterEvent
from support.console_process import ConsoleClient, address, console_process
from support.detector_process import NODE

from soak.finding import Finding
from soak.subject import Subject, exceptions_in

_PATIENCE_S = 20.0
_ATTACKERS = 250
"""Addresses from which requests come, each with its own budget; 127.0.0.0/8 is all of this machine."""
_PATHS = (
    "/", "/login", "/metrics", "/ws", "/image?node=/yolov5&camera=", "/page/main.js", "/page/../process.py",
    "/page/%2e%2e/%2e%2e/token", "//evil.example/", "/login?next=http://evil.example", "/\u00e9", "*", "",
    "http://evil.example/", "/page/" + "a" * 20_000,
)  # fmt: skip
_METHODS = (
    "GET",
    "GET",
    "GET",
    "POST",
    "HEAD",
    "OPTIONS",
    "PUT",
    "DELETE",
    "TRACE",
    "CONNECT",
    "get",
    "\x00",
)
_COOKIES = ("", "console=", "console=admin", "console=" + "A" * 43, "console=\x7f;;=;", "a=" + "b" * 20_000)
_FORMS = (
    "token=", "token=admin", "token=" + "A" * 43, "token=%00", "token=" + "A" * 100_000, "&" * 1000,
    "token=%ff%fe", "\r\n\r\n", '{"token":1}',
)  # fmt: skip
_CHANGE = {"id": 1, "node": NODE, "type": "set", "values": {"confidence_threshold": 0.99}}

Sent = tuple[bytes, bool, Callable[[bytes], bool]]
"""What is sent, whether it is a complete request, and whether an answer is right."""


class Attack:
    """Sends random requests to the console at `port`, as a client without its token may."""

    def __init__(self, seed: int, port: int) -> None:
        self._random = random.Random(seed)
        self._port = port

    def send(self) -> str:
        """Send a request from some address; return the problem, "" if it was answered or disconnected."""
        source = f"127.0.{self._random.randrange(1, 3)}.{self._random.randrange(1, _ATTACKERS)}"
        content, is_complete, is_right = self._random.choice(self._kinds)()
        try:
            with socket.create_connection(
                ("127.0.0.1", self._port), timeout=_PATIENCE_S, source_address=(source, 0)
            ) as connection:
                connection.sendall(content)
                if not is_complete:
                    connection.shutdown(socket.SHUT_WR)
                answer = connection.recv(4096)
        except (BrokenPipeError, ConnectionResetError):
            return ""  # refused while it was still being sent
        except OSError as error:
            return f"{content[:200]!r}: {error}"
        return "" if is_right(answer) else f"{content[:200]!r}: answered with {answer[:100]!r}"

    @property
    def _kinds(self) -> tuple[Callable[[], Sent], ...]:
        return (self._request, self._request, self._form, self._upgrade, self._upgrade, self._noise)

    def _request(self) -> Sent:
        choose = self._random.choice
        lines = [f"{choose(_METHODS)} {choose(_PATHS)} HTTP/1.{choose('0119')}", *self._headers()]
        return self._bytes(lines), True, lambda answer: answer.startswith(b"HTTP/1.1 ")

    def _form(self) -> Sent:
        form = self._random.choice(_FORMS)
        length = self._random.choice([len(form), len(form) + 5, 0, 10**12, -1])
        lines = ["POST /login HTTP/1.1", *self._headers(), f"Content-Length: {length}"]
        is_complete = length <= len(form)
        return (
            self._bytes(lines) + form.encode("latin-1"),
            is_complete,
            lambda answer: (
                b"set-cookie" not in answer.lower() and (answer.startswith(b"HTTP/1.1 ") or not is_complete)
            ),
        )

    def _upgrade(self) -> Sent:
        lines = [f"GET {self._random.choice(('/ws', '/image?node=/yolov5'))} HTTP/1.1", *self._headers()]
        lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
        lines += ["Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA=="]
        message = json.dumps(_CHANGE).encode()
        frame = bytes([0x81, 0xFE, *len(message).to_bytes(2, "big"), 0, 0, 0, 0]) + message
        return (
            self._bytes(lines) + frame,
            True,
            lambda answer: answer.startswith(b"HTTP/1.1 ") and not answer.startswith(b"HTTP/1.1 101"),
        )

    def _noise(self) -> Sent:
        return self._random.randbytes(self._random.choice([1, 10, 1000, 100_000])), False, lambda _: True

    def _headers(self) -> list[str]:
        own = f"127.0.0.1:{self._port}"
        host = self._random.choice(
            [own, own, own, "evil.example", f"evil.example:{self._port}", "", own + ", a"]
        )
        origin = self._random.choice([f"http://{own}", f"http://{own}", "http://evil.example", "null", ""])
        cookie = self._random.choice(_COOKIES).replace("console=", f"console_{self._port}=")
        headers = {"Host": host, "Origin": origin, "Cookie": cookie}
        headers |= {"Authorization": self._random.choice(["", "Bearer ", "Bearer " + "A" * 43, "Basic YTpi"])}
        headers |= {"X-Forwarded-For": "127.0.0.1", "Connection": self._random.choice(["", "close"])}
        return [f"{name}: {value}" for name, value in headers.items() if value]

    @staticmethod
    def _bytes(lines: list[str]) -> bytes:
        return ("\r\n".join(lines) + "\r\n\r\n").encode("latin-1")


def refused_strangers(subject: Subject, count: int, seed: int) -> Finding:
    """Send `count` requests without the token; then a client with the token must be served."""
    events: list[Any] = []
    subject.observer.create_subscription(ParameterEvent, "/parameter_events", events.append, 1000)
    subject.reset()
    subject.observer.work_for(1.0)
    state = subject.node.state()
    events.clear()
    with TemporaryDirectory() as folder:
        token_file = Path(folder) / "token"
        words = ["--host", "0.0.0.0", "--metrics", "--token-file", str(token_file)]
        with console_process(subject.domain, *words) as console:
            port = int(address(console).rstrip("/").rpartition(":")[2])
            attack = Attack(seed, port)
            unanswered = list(filter(None, (attack.send() for _ in range(count))))
            subject.observer.work_for(1.0)
            changes = sum(len(event.changed_parameters) for event in events if event.node == NODE)
            changes += subject.node.state() != state
            client = ConsoleClient(f"http://127.0.0.1:{port}/").logged_in(token_file.read_text().strip())
            with client.page() as page:
                page.wait_for(lambda: NODE in page.nodes, "the detector")
                served = page.set(confidence_threshold=0.5)
            tracebacks = exceptions_in(console.output)
    first = f" (first: {unanswered[0]})" if unanswered else ""
    return Finding(
        claim="without the token nobody changes anything through the console",
        done=f"{count} hostile requests",
        result=f"{len(unanswered)} wrongly or not answered{first}, {changes} changes, "
        f"{len(tracebacks)} tracebacks; then a page with the token: {served or 'served'}",
        limit="0, 0, 0; served",
        is_met=not unanswered and not changes and not tracebacks and not served,
    )
