"""HTTP client for untrusted servers: bounded headers, no chunks of negative size, no insecure redirects."""

from __future__ import annotations

import time
from http.client import HTTPConnection, HTTPException, HTTPMessage, HTTPResponse, HTTPSConnection
from typing import IO, Any, BinaryIO
from urllib.parse import urlsplit
from urllib.request import HTTPHandler, HTTPRedirectHandler, HTTPSHandler, Request, build_opener


class RedirectError(OSError):
    """A refused redirect from the URL `source` to the URL `target`."""

    def __init__(self, source: str, target: str) -> None:
        super().__init__(f"{source}: refused to follow its redirect to {target}")
        self.source = source
        self.target = target


def open_url(request: Request, *, stall_s: float) -> HTTPResponse:
    """The server's response to `request`, redirects followed.

    Each of its headers must be complete `stall_s` seconds after their first line, and data must not pause for
    longer. Raises HTTPError, RedirectError, OSError, HTTPException, ValueError and OverflowError.
    """
    response: HTTPResponse = build_opener(_Handler, _SecureHandler, SafeRedirects).open(
        request, timeout=stall_s
    )
    return response


class SafeRedirects(HTTPRedirectHandler):
    """Redirect handler that rejects redirects from https to any other scheme; never reads the body of one."""

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: HTTPMessage, newurl: str
    ) -> Request | None:
        fp.close()  # else urllib would read the body, which may have no end
        if urlsplit(newurl).scheme not in {"https", req.type}:
            raise RedirectError(req.full_url, newurl)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


class _BoundedStream:
    """What a server sends: headers until a deadline, and no reads of size -1.

    http.client skips responses `100 Continue` without end, and reads a chunk of size -1 without limit.
    """

    def __init__(self, stream: BinaryIO, stall_s: float) -> None:
        self._stream = stream
        self._stall_s = stall_s
        self._deadline_s = float("inf")
        self._is_header = True

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def read(self, size: int = -1) -> bytes:
        if size < 0:
            raise HTTPException("a chunk of negative size")
        return self._stream.read(size)

    def readline(self, limit: int = -1) -> bytes:
        if self._is_header and time.monotonic() > self._deadline_s:
            raise TimeoutError(f"its header was not complete after {self._stall_s:g} s")
        line = self._stream.readline(limit)
        self._deadline_s = min(self._deadline_s, time.monotonic() + self._stall_s)
        return line

    def end_header(self) -> None:
        """From now on lines belong to the body, which may take any time."""
        self._is_header = False


class _Response(HTTPResponse):
    def __init__(self, sock: Any, *arguments: Any, **options: Any) -> None:
        super().__init__(sock, *arguments, **options)
        self._bounded = _BoundedStream(self.fp, sock.gettimeout())
        self.fp = self._bounded  # type: ignore[assignment]

    def begin(self) -> None:
        super().begin()
        self._bounded.end_header()


class _Connection(HTTPConnection):
    response_class = _Response


class _SecureConnection(HTTPSConnection):
    response_class = _Response


class _Handler(HTTPHandler):
    def http_open(self, req: Request) -> HTTPResponse:
        return self.do_open(_Connection, req)


class _SecureHandler(HTTPSHandler):
    def https_open(self, req: Request) -> HTTPResponse:
        return self.do_open(_SecureConnection, req)
