"""A web server on this machine that behaves as badly as a test wants."""

from __future__ import annotations

import contextlib
import re
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from yolov5_lifecycle.checkpoints.locate import WeightsFile
from yolov5_lifecycle.commands.download import fetch

Behaviour = Callable[["ServedRequest"], None]


class ServedRequest(BaseHTTPRequestHandler):
    """One request, answered by the behaviour of its server."""

    server: FileServer

    def do_GET(self) -> None:
        self.server.requests.append((self.path, self.headers.get("Range", "")))
        self.server.behaviour(self)

    def answer(
        self,
        body: bytes,
        *,
        status: int = 200,
        reason: str | None = None,
        length: int | None = None,
        **headers: str,
    ) -> None:
        """Send `body`, announced as `length` bytes."""
        self.send_response(status, reason)
        self.send_header("Content-Length", str(len(body) if length is None else length))
        for name, value in headers.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Quiet."""


class FileServer(ThreadingHTTPServer):
    """Answers every request with `behaviour` while its block lasts.

    `requests` has the paths and ranges that were asked for.
    """

    def __init__(self, behaviour: Behaviour) -> None:
        super().__init__(("127.0.0.1", 0), ServedRequest)
        self.behaviour = behaviour
        self.requests: list[tuple[str, str]] = []
        self.closing = threading.Event()
        self._thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.01})

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def __enter__(self) -> FileServer:
        self._thread.start()
        return self

    def wait(self, _: ServedRequest) -> None:
        """A behaviour: no word, for as long as the server lives."""
        self.closing.wait()

    def __exit__(self, *_: object) -> None:
        self.closing.set()
        self.shutdown()
        self.server_close()
        self._thread.join()


def sending(body: bytes, **options: object) -> Behaviour:
    """The same answer to everybody, whatever range they ask for."""
    return lambda request: request.answer(body, **options)  # type: ignore[arg-type]


def sending_ranges(body: bytes) -> Behaviour:
    """As a good server does: from the byte on that is asked for."""

    def behave(request: ServedRequest) -> None:
        asked = re.fullmatch(r"bytes=(\d+)-", request.headers.get("Range", ""))
        start = int(asked[1]) if asked else 0
        if start >= len(body):
            request.answer(b"", status=416)
        elif start:
            content_range = f"bytes {start}-{len(body) - 1}/{len(body)}"
            request.answer(body[start:], status=206, Content_Range=content_range)
        else:
            request.answer(body)

    return behave


def chunked(*parts: bytes) -> Behaviour:
    """An answer in chunks, each part with its size line before it."""

    def behave(request: ServedRequest) -> None:
        request.send_response(200)
        request.send_header("Transfer-Encoding", "chunked")
        request.end_headers()
        with contextlib.suppress(OSError):  # the client may have had enough
            for part in parts:
                request.wfile.write(part)

    return behave


def stalling(body: bytes, sent_bytes: int) -> Behaviour:
    """The beginning, and then nothing for as long as the server lives."""

    def behave(request: ServedRequest) -> None:
        request.answer(body[:sent_bytes], length=len(body))
        request.server.wait(request)

    return behave


def redirecting(target: str) -> Behaviour:
    """To the same path below `target`."""
    return lambda request: request.answer(b"", status=302, Location=target + request.path)


PATTERN = "/releases/yolov5{size}.pt"


def fetch_from(server: FileServer, folder: Path, *, sha256: str = "", stall_s: float = 20) -> WeightsFile:
    """`fetch_weights n` from that server."""
    return fetch("n", folder, url=server.address + PATTERN, sha256=sha256, stall_s=stall_s)


def unfinished(folder: Path) -> Path:
    return folder / "yolov5n.partial.pt"
