"""Downloads from servers that misbehave: redirected, cut, stalled, damaged, too large."""

from __future__ import annotations

import contextlib
import io
import os
import socket
import subprocess
import sys
import zipfile
from http.client import HTTPMessage
from pathlib import Path
from urllib.request import Request

import pytest
from support.colcon_workspace import REPOSITORY
from support.fetched_weights import PATTERN, fetch_from, unfinished
from support.file_server import (
    Behaviour,
    FileServer,
    ServedRequest,
    chunked,
    redirecting,
    sending,
    sending_ranges,
    stalling,
)

from yolov5_lifecycle.commands.download import DownloadError, SafeRedirects, download, fetch
from yolov5_lifecycle.commands.fetch_weights import main
from yolov5_lifecycle.models.model import WeightsError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder that is not there yet."""
    return tmp_path / "ros" / "yolov5"


@pytest.mark.parametrize("redirects", [1, 2])
def test_a_redirect_is_followed(folder: Path, checkpoint: bytes, redirects: int) -> None:
    with FileServer(sending_ranges(checkpoint)) as last, FileServer(redirecting(last.address)) as second:
        target = last.address if redirects == 1 else second.address
        with FileServer(redirecting(target)) as first:
            assert fetch_from(first, folder).path.read_bytes() == checkpoint


@pytest.mark.parametrize("target", ["file:///etc", "ftp://127.0.0.1:1"])
def test_a_redirect_out_of_the_web_is_refused(folder: Path, target: str) -> None:
    with (
        FileServer(redirecting(target)) as server,
        pytest.raises(DownloadError, match=rf"(?i)redirect.* '?{target}"),
    ):
        fetch_from(server, folder)


def test_a_redirect_in_a_circle_ends(folder: Path) -> None:
    with FileServer(lambda request: redirecting("")(request)) as server:
        with pytest.raises(DownloadError, match="the server answers 302"):
            fetch_from(server, folder)
        assert len(server.requests) < 20


def test_a_file_that_was_cut_is_continued(folder: Path, checkpoint: bytes) -> None:
    half = len(checkpoint) // 2
    with FileServer(sending(checkpoint[:half], length=len(checkpoint))) as server:
        with pytest.raises(DownloadError, match=f"ended after {half} of {len(checkpoint)} bytes; run the co"):
            fetch_from(server, folder)
        assert not (folder / "yolov5n.pt").exists()
        server.behaviour = sending_ranges(checkpoint)
        assert fetch_from(server, folder).path.read_bytes() == checkpoint
    assert server.requests[1] == ("/releases/yolov5n.pt", f"bytes={half}-")


def test_a_stall_ends_and_what_came_is_kept(folder: Path, checkpoint: bytes) -> None:
    with FileServer(stalling(checkpoint, 1 << 15)) as server:
        with pytest.raises(DownloadError, match="no data for 3 s, after 32768 bytes"):
            fetch_from(server, folder, stall_s=3)  # long enough for the beginning on a busy machine
        assert unfinished(folder).stat().st_size == 1 << 15
        server.behaviour = sending_ranges(checkpoint)
        assert fetch_from(server, folder).path.read_bytes() == checkpoint


def test_a_server_that_never_answers_times_out(folder: Path) -> None:
    with (
        FileServer(lambda request: request.server.wait(request)) as server,
        pytest.raises(DownloadError, match=r"no answer \(timed out\)"),
    ):
        fetch_from(server, folder, stall_s=0.2)


def beginning_elsewhere(body: bytes, start: int) -> Behaviour:
    content_range = f"bytes {start}-{len(body) - 1}/{len(body)}"
    return lambda request: request.answer(body[start:], status=206, Content_Range=content_range)


@pytest.mark.long
@pytest.mark.parametrize("earlier", [100, 10**7], ids=["a part", "more than there is"])
@pytest.mark.parametrize("server_kind", ["resumes", "sends all", "begins earlier"])
def test_whatever_the_server_makes_of_a_range_the_file_is_right(
    folder: Path, checkpoint: bytes, earlier: int, server_kind: str
) -> None:
    behaviour = {
        "resumes": sending_ranges(checkpoint),
        "sends all": sending(checkpoint),
        "begins earlier": beginning_elsewhere(checkpoint, 50),
    }[server_kind]
    folder.mkdir(parents=True)
    unfinished(folder).write_bytes((checkpoint + bytes(10**7))[:earlier])
    with FileServer(behaviour) as server:
        assert fetch_from(server, folder).path.read_bytes() == checkpoint


def test_a_gap_is_refused(folder: Path, checkpoint: bytes) -> None:
    with (
        FileServer(beginning_elsewhere(checkpoint, 50)) as server,
        pytest.raises(DownloadError, match="requested bytes from 0 on, got them from 50 on"),
    ):
        fetch_from(server, folder)


@pytest.mark.parametrize(
    ("body", "told"),
    [
        pytest.param(b"<!DOCTYPE html><title>Log in</title>", "found an HTML page", id="page of a portal"),
        pytest.param(b"", "the file is empty", id="nothing"),
        pytest.param(b"PK\x03\x04 and so on", "damaged or cut short", id="damaged"),
    ],
)
def test_what_is_no_checkpoint_is_refused_and_not_kept(folder: Path, body: bytes, told: str) -> None:
    with FileServer(sending(body)) as server, pytest.raises(WeightsError, match=told) as refused:
        fetch_from(server, folder)
    assert str(refused.value).startswith(server.address)
    assert list(folder.glob("*.pt")) == []


@pytest.mark.parametrize("difference", [-1000, -1], ids=str)
def test_a_server_that_announces_too_little_is_not_believed(
    folder: Path, checkpoint: bytes, difference: int
) -> None:
    with (
        FileServer(sending(checkpoint, length=len(checkpoint) + difference)) as server,
        pytest.raises(WeightsError, match="damaged or cut short"),
    ):
        fetch_from(server, folder)
    assert list(folder.glob("*.pt")) == []


def test_a_file_with_another_digest_is_refused_and_not_kept(
    folder: Path, checkpoint: bytes, digest: str
) -> None:
    with (
        FileServer(sending(checkpoint)) as server,
        pytest.raises(WeightsError, match=f"its sha256 is {digest}, expected {'0' * 64}.* It was removed"),
    ):
        fetch_from(server, folder, sha256="0" * 64)
    assert list(folder.glob("*.pt")) == []


FETCHED_WITH_LITTLE_MEMORY = """
import sys
from pathlib import Path
from benchmark.process_memory import limit_growth
from yolov5_lifecycle.commands.download import fetch

def leave_little(done_bytes, total_bytes):
    if done_bytes == total_bytes:
        limit_growth(total_bytes / 4 / 1024**2)

fetch("n", Path(sys.argv[1]), url=sys.argv[2], progress=leave_little)
"""


def enlarged(checkpoint: bytes) -> bytes:
    """The same model in so many bytes that no heap has them in store; what is added is not looked at."""
    file = io.BytesIO(checkpoint)
    with zipfile.ZipFile(file, "a") as archive:
        folder = archive.namelist()[0].partition("/")[0]
        archive.writestr(f"{folder}/unused", bytes(40 << 20))
    return file.getvalue()


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does")
def test_a_download_that_could_not_be_checked_for_lack_of_memory_is_kept_and_used_later(
    folder: Path, checkpoint: bytes
) -> None:
    large = enlarged(checkpoint)
    with FileServer(sending(large)) as server:
        command = [sys.executable, "-c", FETCHED_WITH_LITTLE_MEMORY, str(folder), server.address + PATTERN]
        one_heap = os.environ | {"MALLOC_ARENA_MAX": "1"}  # else that of a thread has room in reserve
        run = subprocess.run(
            command, cwd=REPOSITORY, env=one_heap, capture_output=True, text=True, check=False
        )
        assert "not enough memory to read it; free some. The download is kept" in run.stderr
        assert fetch_from(server, folder).path.stat().st_size == len(large)
    assert len(server.requests) == 1
    assert not unfinished(folder).exists()


@pytest.mark.parametrize("status", [403, 404, 500, 503])
def test_an_error_of_the_server_is_reported_with_the_address_and_a_remedy(folder: Path, status: int) -> None:
    page = b"<html>an error page</html>"
    with FileServer(sending(page, status=status)) as server, pytest.raises(DownloadError) as refused:
        fetch_from(server, folder)
    assert f"{server.address}/releases/yolov5n.pt: the server answers {status}" in str(refused.value)
    assert f"Or copy yolov5n.pt into {folder}" in str(refused.value)


ESCAPES = "\x1b]0;owned\x07\x1b[2J" + "x" * 5000


@pytest.mark.parametrize(
    ("behaviour", "told"),
    [
        pytest.param(
            sending(b"x", status=404, reason=ESCAPES), "the server answers 404 ?]0;owned?", id="reason"
        ),
        pytest.param(redirecting(f"ftp://{ESCAPES}"), "", id="redirect"),
        pytest.param(redirecting("http://127.0.0.1:99999999"), "no answer", id="redirect to no port"),
        pytest.param(
            sending(b"x", status=206, Content_Range=f"bytes {'9' * 5000}-"), "the range of a part", id="range"
        ),
        pytest.param(sending(b"x", status=206), "the range of a part", id="part without a range"),
        pytest.param(
            sending(b"x", status=206, Content_Range="bytes \xb2-3/4"), "the range of a part", id="odd digit"
        ),
        pytest.param(chunked(b"no number\r\n"), "the connection broke", id="chunk of no size"),
        pytest.param(chunked(b"f" * 5000 + b"\r\nhello"), "the connection broke", id="chunk of a huge size"),
    ],
)
def test_a_malformed_answer_is_one_short_line_and_leaves_no_file(
    folder: Path, capsys: pytest.CaptureFixture[str], behaviour: Behaviour, told: str
) -> None:
    with FileServer(behaviour) as server:
        assert main(["n", "--dir", str(folder), "--url", server.address + PATTERN]) == 1
    output, error = capsys.readouterr()
    _licence, line = error.splitlines()
    assert output == ""
    assert told in line
    assert line.isprintable()
    assert len(line) < 1000
    assert [path.stat().st_size for path in folder.glob("*.pt")] == []


def test_a_chunked_answer_is_read(folder: Path, checkpoint: bytes) -> None:
    half = len(checkpoint) // 2
    chunks = [b"%x\r\n%b\r\n" % (len(part), part) for part in (checkpoint[:half], checkpoint[half:])]
    with FileServer(chunked(*chunks, b"0\r\n\r\n")) as server:
        assert fetch_from(server, folder).path.read_bytes() == checkpoint


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


def test_an_unreachable_server_is_reported(folder: Path) -> None:
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{deaf.getsockname()[1]}/{{size}}.pt"
        with pytest.raises(
            DownloadError, match=r"no answer \(.*refused\); check the address and the network"
        ):
            fetch("n", folder, url=url)


CONTENT = bytes(range(256)) * 100


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


@pytest.mark.parametrize("pause_s", [0, 0.05], ids=["as fast as it can", "now and then"])
def test_a_server_that_says_continue_without_end_is_not_listened_to(tmp_path: Path, pause_s: float) -> None:
    with (
        FileServer(continuing(pause_s)) as server,
        pytest.raises(DownloadError, match=r"no answer \(its header was not complete after 1 s\)"),
    ):
        downloaded(server, tmp_path / "file", stall_s=0.5)


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
    with pytest.raises(DownloadError, match="https://a/b: refused to follow its redirect to http://c/d"):
        SafeRedirects().redirect_request(
            Request("https://a/b"), page, 302, "Found", HTTPMessage(), "http://c/d"
        )
    assert page.closed
