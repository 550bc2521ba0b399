"""A hostile server can neither stall a download forever nor redirect it to an insecure address."""

from __future__ import annotations

import contextlib
import io
from http.client import HTTPMessage
from pathlib import Path
from urllib.request import Request

import pytest
from support.file_server import Behaviour, FileServer, ServedRequest, sending

from yolov5_lifecycle.commands.download import DownloadError, download
from yolov5_lifecycle.commands.http_client import RedirectError, SafeRedirects

CONTENT = bytes(range(256)) * 100


@pytest.fixture(autouse=True)
def _without_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "*")


def downloaded(server: FileServer, path: Path, *, stall_s: float = 20) -> bytes:
    with path.open("ab") as file:
        download(server.address, file, max_bytes=10**6, stall_s=stall_s, progress=lambda *_: None)
    return path.read_bytes()


def continuing(pause_s: float) -> Behaviour:
    """`100 Continue` for as long as the server lives and the client listens."""

    def behave(request: ServedRequest) -> None:
        with contextlib.suppress(OSError):  # the client may have had enough
            while not request.server.closing.wait(pause_s):
                request.wfile.write(b"HTTP/1.1 100 Continue\r\n\r\n")

    return behave


@pytest.mark.long
@pytest.mark.parametrize("pause_s", [0, 0.05], ids=["as fast as it can", "now and then"])
def test_a_server_that_says_continue_without_end_is_not_listened_to(tmp_path: Path, pause_s: float) -> None:
    with (
        FileServer(continuing(pause_s)) as server,
        pytest.raises(DownloadError, match=r"no answer \(its header was not complete after 2 s\)"),
    ):
        downloaded(server, tmp_path / "file", stall_s=2)  # long enough for every answer on a busy machine


def test_an_answer_after_continue_is_taken(tmp_path: Path) -> None:
    def behave(request: ServedRequest) -> None:
        request.send_response_only(100)
        request.end_headers()
        sending(CONTENT)(request)

    with FileServer(behave) as server:
        assert downloaded(server, tmp_path / "file") == CONTENT


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
    with pytest.raises(RedirectError, match="https://a/b: refused to follow its redirect to http://c/d"):
        SafeRedirects().redirect_request(
            Request("https://a/b"), page, 302, "Found", HTTPMessage(), "http://c/d"
        )
    assert page.closed
