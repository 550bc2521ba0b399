"""Downloads from servers that misbehave: redirected, cut, stalled, damaged, too large."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Callable
from http.client import HTTPMessage
from pathlib import Path
from urllib.request import Request

import pytest
from support.file_server import (
    PATTERN,
    Behaviour,
    FileServer,
    ServedRequest,
    chunked,
    fetch_from,
    redirecting,
    sending,
    sending_ranges,
    stalling,
    unfinished,
)
from support.refusals import Refused

from yolov5_lifecycle.checkpoints.locate import WeightsFile
from yolov5_lifecycle.commands import download as module
from yolov5_lifecycle.commands.download import DownloadError, SafeRedirects, download
from yolov5_lifecycle.commands.fetch_weights import main
from yolov5_lifecycle.models.model import UncheckedError, WeightsError


def test_redirects_are_followed(tmp_path: Path, checkpoint: bytes) -> None:
    with (
        FileServer(sending_ranges(checkpoint)) as last,
        FileServer(redirecting(last.address)) as second,
        FileServer(redirecting(second.address)) as first,
    ):
        assert fetch_from(first, tmp_path).path.read_bytes() == checkpoint


def test_a_file_that_was_cut_is_continued(tmp_path: Path, checkpoint: bytes) -> None:
    half = len(checkpoint) // 2
    with FileServer(sending(checkpoint[:half], length=len(checkpoint))) as server:
        with pytest.raises(DownloadError, match=f"ended after {half} of {len(checkpoint)} bytes; run the co"):
            fetch_from(server, tmp_path)
        assert not (tmp_path / "yolov5n.pt").exists()
        server.behaviour = sending_ranges(checkpoint)
        assert fetch_from(server, tmp_path).path.read_bytes() == checkpoint
    assert server.requests[1] == ("/releases/yolov5n.pt", f"bytes={half}-")


def test_a_stall_ends_and_what_came_is_kept(tmp_path: Path, checkpoint: bytes) -> None:
    with FileServer(stalling(checkpoint, 1 << 15)) as server:
        with pytest.raises(DownloadError, match="no data for 3 s, after 32768 bytes"):
            fetch_from(server, tmp_path, stall_s=3)  # long enough for the beginning on a busy machine
        assert unfinished(tmp_path).stat().st_size == 1 << 15
        server.behaviour = sending_ranges(checkpoint)
        assert fetch_from(server, tmp_path).path.read_bytes() == checkpoint


def test_a_server_that_never_answers_times_out(tmp_path: Path) -> None:
    with (
        FileServer(lambda request: request.server.wait(request)) as server,
        pytest.raises(DownloadError, match=r"no answer \(timed out\)"),
    ):
        fetch_from(server, tmp_path, stall_s=0.2)


def beginning_elsewhere(body: bytes, start: int) -> Behaviour:
    content_range = f"bytes {start}-{len(body) - 1}/{len(body)}"
    return lambda request: request.answer(body[start:], status=206, Content_Range=content_range)


def test_a_beginning_that_is_longer_than_the_file_is_removed(tmp_path: Path, checkpoint: bytes) -> None:
    unfinished(tmp_path).write_bytes(bytes(len(checkpoint) + 1))
    with FileServer(sending_ranges(checkpoint)) as server:
        with pytest.raises(WeightsError, match="It was removed"):
            fetch_from(server, tmp_path)
        assert fetch_from(server, tmp_path).path.read_bytes() == checkpoint


def test_a_download_that_could_not_be_checked_is_kept_and_used_later(
    tmp_path: Path, checkpoint: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_memory(path: Path) -> WeightsFile:
        raise UncheckedError(f"{path}: not enough memory to read it; free some.")

    with FileServer(sending_ranges(checkpoint)) as server:
        with monkeypatch.context() as patch:
            patch.setattr(module, "load_weights", no_memory)
            with pytest.raises(UncheckedError, match="The download is kept: then run the command again"):
                fetch_from(server, tmp_path)
        assert fetch_from(server, tmp_path).path.read_bytes() == checkpoint
    assert [asked for _, asked in server.requests] == ["", f"bytes={len(checkpoint)}-"]
    assert not unfinished(tmp_path).exists()


ESCAPES = "\x1b]0;owned\x07\x1b[2J" + "x" * 5000


@pytest.mark.parametrize(
    ("behave", "told"),
    [
        pytest.param(
            lambda _: sending(b"<html>an error</html>", status=404),
            "/releases/yolov5n.pt: the server answers 404.*Or copy yolov5n.pt into ",
            id="error of the server",
        ),
        pytest.param(
            lambda _: sending(b"x", status=500, reason=ESCAPES),
            r"the server answers 500 \?]0;owned\?",
            id="reason of escapes",
        ),
        pytest.param(
            lambda _: redirecting("file:///etc"), "[Rr]edirect.* '?file:///etc", id="redirect to a file"
        ),
        pytest.param(lambda _: redirecting(f"ftp://{ESCAPES}"), "", id="redirect to escapes"),
        pytest.param(lambda _: redirecting("http://127.0.0.1:99999999"), "no answer", id="no port"),
        pytest.param(
            lambda _: sending(b"x", status=206, Content_Range=f"bytes {'9' * 5000}-"),
            "bytes from 0 on, got 'bytes 999",
            id="huge range",
        ),
        pytest.param(lambda _: sending(b"x", status=206), "from 0 on, got ''", id="part without a range"),
        pytest.param(
            lambda body: beginning_elsewhere(body, 50), "bytes from 0 on, got 'bytes 50-", id="a gap"
        ),
        pytest.param(lambda _: chunked(b"no number\r\n"), "the connection broke", id="chunk of no size"),
        pytest.param(
            lambda _: sending(b"<!DOCTYPE html>Log in"), "found an HTML page", id="page of a portal"
        ),
        pytest.param(
            lambda body: sending(body, length=len(body) - 1),
            "damaged or cut short",
            id="announces too little",
        ),
    ],
)
def test_a_bad_answer_is_one_short_line_with_the_address_and_leaves_no_file(
    tmp_path: Path, checkpoint: bytes, refused: Refused, behave: Callable[[bytes], Behaviour], told: str
) -> None:
    with FileServer(behave(checkpoint)) as server:
        error = refused(main, "n", "--dir", tmp_path, "--url", server.address + PATTERN)
    _licence, line = error.splitlines()
    assert re.search(told, line), line
    assert line.startswith(f"fetch_weights: {server.address}")
    assert line.isprintable()
    assert len(line) < 1000


def test_the_chunked_answer_of_a_server_that_knows_no_ranges_is_taken_from_its_beginning(
    tmp_path: Path, checkpoint: bytes
) -> None:
    unfinished(tmp_path).write_bytes(checkpoint[:100])
    half = len(checkpoint) // 2
    chunks = [b"%x\r\n%b\r\n" % (len(part), part) for part in (checkpoint[:half], checkpoint[half:])]
    with FileServer(chunked(*chunks, b"0\r\n\r\n")) as server:
        assert fetch_from(server, tmp_path).path.read_bytes() == checkpoint


@pytest.mark.parametrize(
    ("header", "begin"),
    [
        pytest.param(("Content-Length", str(10**12)), b"", id="announced"),
        pytest.param(("Content-Type", "text/plain"), b"", id="found out"),
        pytest.param(("Transfer-Encoding", "chunked"), b"5\r\nhello\r\n-1\r\n", id="a negative chunk later"),
    ],
)
def test_more_than_the_limit_is_not_taken(tmp_path: Path, header: tuple[str, str], begin: bytes) -> None:
    def endless(request: ServedRequest) -> None:
        request.send_response(200)
        request.send_header(*header)
        request.end_headers()
        with contextlib.suppress(OSError):
            request.wfile.write(begin)
            while True:
                request.wfile.write(bytes(1 << 16))

    with FileServer(endless) as server, (tmp_path / "file").open("ab") as file:
        with pytest.raises(DownloadError, match="the limit is 1000000"):
            download(server.address, file, max_bytes=10**6, stall_s=20, progress=lambda *_: None)
        assert file.tell() <= 10**6 + (1 << 14)


CONTENT = bytes(range(256)) * 100


def downloaded(server: FileServer, path: Path, *, stall_s: float = 20) -> bytes:
    with path.open("ab") as file:
        download(server.address, file, max_bytes=10**6, stall_s=stall_s, progress=lambda *_: None)
    return path.read_bytes()


def test_a_server_that_says_continue_without_end_is_not_listened_to(tmp_path: Path) -> None:
    def continuing(request: ServedRequest) -> None:
        with contextlib.suppress(OSError):  # the client may have had enough
            while not request.server.closing.wait(0.05):
                request.wfile.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    with (
        FileServer(continuing) as server,
        pytest.raises(DownloadError, match=r"no answer \(its header was not complete after 1 s\)"),
    ):
        downloaded(server, tmp_path / "file", stall_s=0.5)


def test_the_endless_body_of_a_redirect_is_not_read(tmp_path: Path) -> None:
    def behave(request: ServedRequest) -> None:
        request.send_response(302)
        request.send_header("Location", last.address)
        request.end_headers()
        with contextlib.suppress(OSError):  # the client has had enough
            while True:
                request.wfile.write(bytes(1 << 16))

    with FileServer(sending(CONTENT)) as last, FileServer(behave) as first:
        assert downloaded(first, tmp_path / "file") == CONTENT


def test_a_redirect_from_https_to_http_is_refused() -> None:
    page = io.BytesIO()
    with pytest.raises(DownloadError, match="https://a/b: refused to follow its redirect to http://c/d"):
        SafeRedirects().redirect_request(
            Request("https://a/b"), page, 302, "Found", HTTPMessage(), "http://c/d"
        )
    assert page.closed
