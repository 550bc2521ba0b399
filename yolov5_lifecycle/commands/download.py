"""Resumable HTTP download of one file from a server that is not trusted."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from http.client import HTTPException, HTTPMessage, HTTPResponse
from typing import IO, BinaryIO
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from yolov5_lifecycle.printable import in_one_line

_CHUNK_BYTES = 1 << 14
_PARTIAL_CONTENT = 206
_RANGE_NOT_SATISFIABLE = 416
_MAX_SHOWN = 200
_AGAIN = "run the command again to resume"

Progress = Callable[[int, "int | None"], object]
"""Called with the bytes received so far and the total, None unless the server sends it."""


class DownloadError(RuntimeError):
    """A failed download; the message is one printable line with the URL, the cause and a remedy."""

    def __init__(self, message: str) -> None:
        super().__init__(in_one_line(message))


def download(url: str, file: BinaryIO, *, max_bytes: int, stall_s: float, progress: Progress) -> None:
    """Append the missing rest of the file at `url` to `file`, opened with "ab".

    Bytes received before an error stay in `file`, for the next call. Raises DownloadError if the server or
    connection fails, no data arrives for `stall_s` seconds or more than `max_bytes` do, and OSError if `file`
    cannot be written.
    """
    with _answer(url, file.tell(), stall_s) as response:
        start = _start_byte(response, url)
        if start > file.tell():
            raise DownloadError(
                f"{url}: requested bytes from {file.tell()} on, got them from {start} on; try a mirror"
            )
        file.truncate(start)
        file.seek(start)
        total = None if response.length is None else start + response.length
        _check_size(url, total or 0, max_bytes)
        while chunk := _next_chunk(response, url, file.tell(), total, stall_s):
            file.write(chunk)
            _check_size(url, file.tell(), max_bytes)
            progress(file.tell(), total)
    if total is not None and file.tell() != total:
        raise DownloadError(f"{url}: the connection ended after {file.tell()} of {total} bytes; {_AGAIN}")


class SafeRedirects(HTTPRedirectHandler):
    """Rejects redirects from https to any other scheme, and reads the body of none."""

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: HTTPMessage, newurl: str
    ) -> Request | None:
        fp.close()  # else urllib would read the body, which may have no end
        if urlsplit(newurl).scheme not in {"https", req.type}:
            source, target = _short(req.full_url), _short(newurl)
            raise DownloadError(f"{source}: refused to follow its redirect to {target}; try a mirror")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _answer(url: str, start: int, stall_s: float) -> HTTPResponse:
    if not url.startswith(("https://", "http://")):
        raise DownloadError(f"{url}: expected an address that begins with https:// or http://")
    try:
        request = Request(url, headers={"Range": f"bytes={start}-"} if start else {})
        return _opened(request, stall_s)
    except HTTPError as error:
        error.close()
        if error.code == _RANGE_NOT_SATISFIABLE and start:
            return _answer(url, 0, stall_s)
        raise DownloadError(
            f"{url}: the server answers {error.code} {_short(error.reason)}; check the address"
        ) from None
    except (OSError, HTTPException, ValueError, OverflowError) as error:  # OverflowError: port above 65535
        reason = _short(getattr(error, "reason", error)) or type(error).__name__
        raise DownloadError(f"{url}: no answer ({reason}); check the address and the network") from None


def _opened(request: Request, stall_s: float) -> HTTPResponse:
    """The response after redirects; TimeoutError unless its header is complete within twice `stall_s`.

    That needs a thread, left to itself then: http.client skips responses `100 Continue` without end.
    """
    answers: list[HTTPResponse] = []
    problems: list[Exception] = []

    def run() -> None:
        try:
            answers.append(build_opener(SafeRedirects).open(request, timeout=stall_s))
        except Exception as error:  # noqa: BLE001 - raised below
            problems.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(2 * stall_s)
    if problems:
        raise problems.pop()
    if not answers:
        raise TimeoutError(f"its header was not complete after {2 * stall_s:g} s")
    return answers.pop()


def _short(foreign: object) -> str:
    return str(foreign)[:_MAX_SHOWN]


def _start_byte(response: HTTPResponse, url: str) -> int:
    """Offset of the first byte in the response: 0 unless the server sends the requested range."""
    if response.status != _PARTIAL_CONTENT:
        return 0
    content_range = response.headers.get("Content-Range", "")
    found = re.match(r"bytes (\d{1,18})-", content_range, re.ASCII)
    if found is None:
        raise DownloadError(
            f"{url}: expected the range of a part as `bytes 100-200/300`, found {_short(content_range)!r}; "
            "try a mirror"
        )
    return int(found[1])


def _check_size(url: str, size_bytes: int, max_bytes: int) -> None:
    if size_bytes > max_bytes:
        raise DownloadError(f"{url}: {size_bytes} bytes or more, the limit is {max_bytes}; check the address")


def _next_chunk(
    response: HTTPResponse, url: str, done_bytes: int, total: int | None, stall_s: float
) -> bytes:
    """Up to _CHUNK_BYTES more, b"" at the end. `read` would take all that comes as a chunk of size -1."""
    left = _CHUNK_BYTES if total is None else max(total - done_bytes, 0)
    try:
        return response.read1(min(left, _CHUNK_BYTES))
    except TimeoutError:
        reason = f"no data for {stall_s:g} s"
    except (OSError, HTTPException, ValueError, OverflowError) as error:
        reason = f"the connection broke ({type(error).__name__})"
    raise DownloadError(f"{url}: {reason}, after {done_bytes} bytes; {_AGAIN}")
