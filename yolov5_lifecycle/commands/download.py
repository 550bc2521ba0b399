"""Resumable HTTP download of a weights file from a server that is not trusted."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from http.client import HTTPException, HTTPMessage, HTTPResponse
from pathlib import Path
from typing import IO, BinaryIO
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import HTTPRedirectHandler, Request, build_opener

from yolov5_lifecycle.atomic_file import hold, open_itself
from yolov5_lifecycle.checkpoints.locate import MAX_FILE_BYTES, WeightsFile, load_weights
from yolov5_lifecycle.models.model import UncheckedError, WeightsError
from yolov5_lifecycle.printable import in_one_line

_STALL_S = 30.0
_CHUNK_BYTES = 1 << 14
_PARTIAL_CONTENT = 206
_RANGE_NOT_SATISFIABLE = 416
_MAX_SHOWN = 200
_AGAIN = "run the command again to resume"
_BROKEN = (OSError, HTTPException, ValueError, OverflowError)
"""What an address or an answer may raise; OverflowError for a port above 65535."""

Progress = Callable[[int, "int | None"], object]
"""Called with the bytes received so far and the total, None unless the server sends it."""


class DownloadError(RuntimeError):
    """A failed download; the message is one printable line with the URL, the cause and a remedy."""

    def __init__(self, message: str) -> None:
        super().__init__(in_one_line(message))


def fetch(
    model: str,
    folder: Path,
    *,
    url: str,
    sha256: str = "",
    stall_s: float = _STALL_S,
    progress: Progress = lambda done_bytes, total_bytes: None,
) -> WeightsFile:
    """Load yolov5`model`.pt from `folder`, downloading it if it does not exist.

    `url` contains the placeholder `{size}`. The resulting file is complete, readable and, with `sha256`, has
    that digest. An unfinished or unchecked download is kept beside it and resumed by the next call; one with
    another digest or without a model is removed. Raises DownloadError, WeightsError or OSError.
    """
    target = folder / f"yolov5{model}.pt"
    if os.path.lexists(target):
        return _already_there(target, sha256)
    if "{size}" not in url:
        raise DownloadError(
            f"{url}: expected an address with {{size}} in it, as in https://HOST/yolov5{{size}}.pt"
        )
    url = url.replace("{size}", model)
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = target.with_suffix(".partial.pt")
    with open(unfinished, "ab", opener=open_itself) as file:
        if not hold(file.fileno(), unfinished):
            raise DownloadError(f"another fetch_weights is running in {folder}: wait until it has finished")
        try:
            download(url, file, max_bytes=MAX_FILE_BYTES, stall_s=stall_s, progress=progress)
            file.flush()
            os.fsync(file.fileno())
        except BaseException as error:
            if file.tell() == 0:  # nothing to resume
                unfinished.unlink()
            if isinstance(error, DownloadError):
                raise DownloadError(f"{error}. Or copy {target.name} into {folder} by other means.") from None
            raise
        found = _checked(unfinished, url, sha256)
        unfinished.replace(target)
    return replace(found, path=target.resolve())


def _already_there(path: Path, sha256: str) -> WeightsFile:
    try:
        return load_weights(path, sha256=sha256)
    except UncheckedError:
        raise
    except WeightsError as error:
        raise WeightsError(f"{error} The file was there before: remove it to have it downloaded.") from None


def _checked(path: Path, url: str, sha256: str) -> WeightsFile:
    """The downloaded model; an invalid file is removed, since it cannot be resumed."""
    try:
        found = load_weights(path)  # why it is no model, as a login page is none, says more than its digest
        return load_weights(path, sha256=sha256) if sha256 else found
    except UncheckedError as error:
        raise UncheckedError(f"{error} The download is kept: then run the command again.") from None
    except WeightsError as error:
        path.unlink()
        raise WeightsError(f"{url}: {str(error).removeprefix(f'{path}: ')} It was removed.") from None


def download(url: str, file: BinaryIO, *, max_bytes: int, stall_s: float, progress: Progress) -> None:
    """Append the missing rest of the file at `url` to `file`, opened with "ab".

    Bytes received before an error stay in `file`, for the next call. Raises DownloadError if the server or
    connection fails, no data arrives for `stall_s` seconds or more than `max_bytes` do, and OSError if `file`
    cannot be written.
    """
    start = file.tell()
    response = _answer(url, start, stall_s)
    if response is None:
        return
    with response:
        if response.status != _PARTIAL_CONTENT:  # all of the file
            start = 0
            file.truncate(start)
            file.seek(start)
        elif not (content_range := response.headers.get("Content-Range", "")).startswith(f"bytes {start}-"):
            raise DownloadError(
                f"{url}: requested bytes from {start} on, got {_short(content_range)!r}; try a mirror"
            )
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


def _answer(url: str, start: int, stall_s: float) -> HTTPResponse | None:
    """The response with the bytes from `start` on, after redirects; None if there are none."""
    if not url.startswith(("https://", "http://")):
        raise DownloadError(f"{url}: expected an address that begins with https:// or http://")
    try:
        request = Request(url, headers={"Range": f"bytes={start}-"} if start else {})
        return _opened_url(request, stall_s)
    except HTTPError as error:
        error.close()
        if error.code == _RANGE_NOT_SATISFIABLE and start:
            return None
        raise DownloadError(
            f"{url}: the server answers {error.code} {_short(error.reason)}; check the address"
        ) from None
    except _BROKEN as error:
        reason = _short(getattr(error, "reason", error)) or type(error).__name__
        raise DownloadError(f"{url}: no answer ({reason}); check the address and the network") from None


def _opened_url(request: Request, stall_s: float) -> HTTPResponse:
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
    except _BROKEN as error:
        reason = f"the connection broke ({type(error).__name__})"
    raise DownloadError(f"{url}: {reason}, after {done_bytes} bytes; {_AGAIN}")
