"""The installed `console` as a process of its own, and clients that do what its page does."""

from __future__ import annotations

import http.client
import itertools
import json
import re
import struct
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode, urlsplit

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from support.detector_process import NODE, environment
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.observer import PATIENCE_S

_ADDRESS = re.compile(r"console: (http\S+)")
_STAMP = struct.Struct("<d")
_MAX_MESSAGE_BYTES = 1 << 26


@contextmanager
def console_process(domain: int, *arguments: str, port: int = 0) -> Iterator[ChildProcess]:
    """The installed `console` once it serves, with port 0 on a free port."""
    command = [entry_point("console"), "--port", str(port), *arguments]
    with ChildProcess("console", command, environment(domain)) as process:
        process.wait_for_output("console: http", PATIENCE_S)
        yield process


def address(console: ChildProcess) -> str:
    """The address that a console has announced."""
    found = _ADDRESS.search(console.output)
    assert found, console.output
    return found[1]


def closing_code(connection: ClientConnection) -> int:
    """Receive until the console closes the connection; the code that it gives, or 0."""
    try:
        while True:
            connection.recv(PATIENCE_S)
    except ConnectionClosed as closed:
        return closed.rcvd.code if closed.rcvd else 0


@dataclass(frozen=True)
class Reply:
    """Status, headers in lower case and body of an HTTP response."""

    status: int
    headers: dict[str, str]
    body: str


@dataclass(frozen=True)
class ConsoleClient:
    """Browser of the console at `url`; `cookie` is that of a session, if it has one."""

    url: str
    cookie: str = ""

    @property
    def origin(self) -> str:
        return self.url.rstrip("/")

    @property
    def cookie_name(self) -> str:
        """Name of the cookie with the id of a session."""
        return f"console_{urlsplit(self.url).port}"

    def request(
        self, method: str, path: str, *, headers: Mapping[str, str] | None = None, body: str | None = None
    ) -> Reply:
        """Send a request; `headers` are added to those of the browser, "" removes one."""
        own = {"Host": urlsplit(self.url).netloc, "Cookie": self.cookie} | dict(headers or {})
        place = urlsplit(self.url)
        with closing(
            http.client.HTTPConnection(place.hostname or "", place.port, timeout=PATIENCE_S)
        ) as connection:
            connection.putrequest(method, path, skip_host=True)
            for name, value in own.items():
                if value:
                    connection.putheader(name, value)
            if body is not None:
                connection.putheader("Content-Length", str(len(body)))
            connection.endheaders(body.encode() if body is not None else None)
            response = connection.getresponse()
            found = {name.lower(): value for name, value in response.getheaders()}
            return Reply(response.status, found, response.read().decode())

    def logged_in(self, token: str) -> ConsoleClient:
        """The same browser with a session."""
        reply = self.log_in(token)
        assert reply.status == 204, reply
        return ConsoleClient(self.url, reply.headers["set-cookie"].partition(";")[0])

    def log_in(self, token: str, **headers: str) -> Reply:
        own = {"Authorization": f"Bearer {token}", "Origin": self.origin} | headers
        return self.request("POST", "/login", headers=own)

    def socket(self, path: str, *, headers: Mapping[str, str] | None = None) -> ClientConnection:
        """An open WebSocket."""
        own = {"Origin": self.origin, "Cookie": self.cookie} | dict(headers or {})
        return connect(
            "ws" + self.url.removeprefix("http").rstrip("/") + path,
            additional_headers={name: value for name, value in own.items() if value},
            compression=None,
            max_queue=None,  # with a full one it answers no pings, and reads no end
            max_size=_MAX_MESSAGE_BYTES,
            open_timeout=PATIENCE_S,
            proxy=None,
        )

    @contextmanager
    def page(self) -> Iterator[Page]:
        with self.socket("/ws") as connection:
            yield Page(connection)

    @contextmanager
    def viewer(self, node: str = NODE, camera: str = "") -> Iterator[Viewer]:
        with self.socket("/image?" + urlencode({"node": node, "camera": camera})) as connection:
            yield Viewer(connection)


class Page:
    """What a page has received: `nodes` by name, those `gone` and what was told of them last as `lost`, and
    `answers` by the id of the request."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection
        self.nodes: dict[str, dict[str, Any]] = {}
        self.gone: list[str] = []
        self.lost: dict[str, dict[str, Any]] = {}
        self.answers: dict[object, dict[str, Any]] = {}
        self._ids = itertools.count(1)
        self.welcome = self._receive(PATIENCE_S)

    def wait_for(self, condition: Callable[[], object], what: str) -> None:
        """Receive until `condition()`."""
        deadline_s = time.monotonic() + PATIENCE_S
        while not condition():
            left_s = deadline_s - time.monotonic()
            assert left_s > 0, f"timed out waiting for {what}"
            with suppress(TimeoutError):
                self._receive(left_s)

    def wait_for_state(self, state: str, node: str = NODE) -> dict[str, Any]:
        """Wait until the node is shown in that state; its last value."""
        self.wait_for(lambda: node in self.nodes and self.nodes[node]["state"] == state, f"{node} {state}")
        return self.nodes[node]

    def parameter(self, name: str, node: str = NODE) -> dict[str, Any]:
        (found,) = [one for one in self.nodes[node]["parameters"] if one["name"] == name]
        return dict(found)

    def begin(self, **request: Any) -> int:
        """Send a request; its id."""
        number = next(self._ids)
        self.connection.send(json.dumps({"id": number, "node": NODE} | request))
        return number

    def ask(self, **request: Any) -> str:
        """Send a request; the reason for its refusal, "" if it was done."""
        number = self.begin(**request)
        self.wait_for(lambda: number in self.answers, "an answer")
        answer = self.answers[number]
        assert answer["ok"] == (answer["reason"] == ""), answer
        return str(answer["reason"])

    def set(self, **values: Any) -> str:
        return self.ask(type="set", values=values)

    def transition(self, label: str) -> str:
        return self.ask(type="transition", label=label)

    def _receive(self, timeout_s: float) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(self.connection.recv(timeout_s))
        if message["type"] == "node":
            self.nodes[message["node"]["name"]] = message["node"]
        elif message["type"] == "gone":
            name = message["node"]["name"]
            self.nodes.pop(name, None)
            self.gone.append(name)
            self.lost[name] = message["node"]
        elif message["type"] == "answer":
            self.answers[message["id"]] = message
        return message


class Viewer:
    """What draws the images of one camera."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection

    def receive(self, timeout_s: float = PATIENCE_S) -> tuple[float, bytes]:
        """Stamp in seconds and JPEG of the next image."""
        message = self.connection.recv(timeout_s)
        assert isinstance(message, bytes)
        return _STAMP.unpack_from(message)[0], message[_STAMP.size :]

    def take(self) -> None:
        """Say that the image has been drawn."""
        self.connection.send("taken")
