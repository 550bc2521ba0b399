"""One file over HTTP, continued where an earlier attempt ended."""

from __future__ import annotations

import re
from collections.abc import Callable
from http.client import HTTPException, HTTPMessage, HTTPResponse
from typing import IO, BinaryIO
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

_CHUNK_BYTES = 1 << 14
_RANGE_NOT_SATISFIABLE = 416
_AGAIN = "give the command again, it goes on from there"

Progress = Callable[[int, "int | None"], object]
"""Called with the bytes that are there and the bytes there will be, if the server has said."""


class DownloadError(RuntimeError):
    """A file did not come; the message has the address, what happened and what to do."""


def download(url: str, file: BinaryIO, *, max_bytes: int, stall_s: float, progress: Progress) -> None:
    """Append to `file`, opened with "ab", what it lacks of the file at `url`.

    What came before an error stays in `file`, for the next call. Raises DownloadError when the server or the
    way to it fails, nothing comes for `stall_s` seconds or more than `max_bytes` do, and OSError when `file`
    cannot be written.
    """
    with _answer(url, file.tell(), stall_s) as response:
        start = _start_byte(response)
        if start > file.tell():
            raise DownloadError(f"{url}: asked from byte {file.tell()} on, got byte {start} on; try a mirror")
        file.truncate(start)
        total = None if response.length is None else start + response.length
        _check_size(url, total or 0, max_bytes)
        while chunk := _next_chunk(response, url, file.tell(), stall_s):
            file.write(chunk)
            _check_size(url, file.tell(), max_bytes)
            progress(file.tell(), total)
    if total is not None and file.tell() != total:
        raise DownloadError(f"{url}: the connection ended after {file.tell()} of {total} bytes; {_AGAIN}")


class SafeRedirects(HTTPRedirectHandler):
    """Follows no redirect from https to anything weaker."""

    def redirect_request(
        self, req: Request, fp: IO[bytes], code: int, msg: str, headers: HTTPMessage, newurl: str
    ) -> Request | None:
        if urlsplit(newurl).scheme not in {"https", req.type}:
            fp.close()
            raise DownloadError(f"{req.full_url}: refused to follow its redirect to {newurl}; try a mirror")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _answer(url: str, start: int, stall_s: float) -> HTTPResponse:
    if not url.startswith(("https://", "http://")):
        raise DownloadError(f"{url}: expected an address that begins with https:// or http://")
    try:
        request = Request(url, headers={"Range": f"bytes={start}-"} if start else {})
        response: HTTPResponse = build_opener(SafeRedirects).open(request, timeout=stall_s)
    except HTTPError as error:
        error.close()
        if error.code == _RANGE_NOT_SATISFIABLE and start:
            return _answer(url, 0, stall_s)
        raise DownloadError(f"{url}: the server answers {error.code} {error.reason}; check it") from None
    except (OSError, HTTPException, ValueError) as error:
        reason = getattr(error, "reason", error) or type(error).__name__
        raise DownloadError(f"{url}: no answer ({reason}); check the address and the network") from None
    return response


def _start_byte(response: HTTPResponse) -> int:
    """Number of the first byte that comes: 0 unless the server does as asked."""
    found = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
    return int(found[1]) if found else 0


def _check_size(url: str, size_bytes: int, max_bytes: int) -> None:
    if size_bytes > max_bytes:
        raise DownloadError(f"{url}: {size_bytes} bytes or more, at most {max_bytes} are taken; check it")


def _next_chunk(response: HTTPResponse, url: str, done_bytes: int, stall_s: float) -> bytes:
    try:
        return response.read(_CHUNK_BYTES)
    except TimeoutError:
        reason = f"nothing came for {stall_s:g} s"
    except (OSError, HTTPException) as error:
        reason = f"the connection broke ({type(error).__name__})"
    raise DownloadError(f"{url}: {reason}, after {done_bytes} bytes; {_AGAIN}")
