"""The command `fetch_weights`, against servers that do their worst."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import pty
import socket
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from support.checkpoint_builder import official_model, saved, stripped
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
from support.random_model import CLASS_NAMES

from yolov5_lifecycle.checkpoints.locate import WeightsFile, find_weights, load_weights
from yolov5_lifecycle.commands.download import DownloadError, download
from yolov5_lifecycle.commands.fetch_weights import fetch, main
from yolov5_lifecycle.models.model import WeightsError

PATTERN = "/releases/yolov5{size}.pt"


@pytest.fixture(scope="module")
def checkpoint() -> bytes:
    return saved(stripped(official_model()))


@pytest.fixture(scope="module")
def digest(checkpoint: bytes) -> str:
    return hashlib.sha256(checkpoint).hexdigest()


@pytest.fixture(autouse=True)
def _without_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "*")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder that is not there yet."""
    return tmp_path / "ros" / "yolov5"


def fetch_from(server: FileServer, folder: Path, *, sha256: str = "", stall_s: float = 20) -> WeightsFile:
    return fetch("n", folder, url=server.address + PATTERN, sha256=sha256, stall_s=stall_s)


def unfinished(folder: Path) -> Path:
    return folder / "yolov5n.partial.pt"


def test_the_file_of_the_size_comes_to_where_the_detector_looks(
    folder: Path, checkpoint: bytes, digest: str
) -> None:
    with FileServer(sending_ranges(checkpoint)) as server:
        fetched = fetch_from(server, folder, sha256=digest)
    assert server.requests == [("/releases/yolov5n.pt", "")]
    assert find_weights(weights="", weights_dir=folder, model_size="n") == fetched.path
    assert fetched.path.read_bytes() == checkpoint
    assert fetched.model.class_names == CLASS_NAMES
    assert not unfinished(folder).exists()


def test_a_file_that_is_there_is_not_asked_for_again(folder: Path, checkpoint: bytes, digest: str) -> None:
    folder.mkdir(parents=True)
    (folder / "yolov5n.pt").write_bytes(checkpoint)
    with FileServer(sending(b"")) as server:
        assert fetch_from(server, folder, sha256=digest).sha256 == digest
        with pytest.raises(WeightsError, match=f"its sha256 is {digest}, expected {'0' * 64}"):
            fetch_from(server, folder, sha256="0" * 64)
    assert server.requests == []
    assert (folder / "yolov5n.pt").exists()


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
        with pytest.raises(
            DownloadError, match=f"ended after {half} of {len(checkpoint)} bytes; give the co"
        ):
            fetch_from(server, folder)
        assert not (folder / "yolov5n.pt").exists()
        server.behaviour = sending_ranges(checkpoint)
        assert fetch_from(server, folder).path.read_bytes() == checkpoint
    assert server.requests[1] == ("/releases/yolov5n.pt", f"bytes={half}-")


def test_a_stall_ends_and_what_came_is_kept(folder: Path, checkpoint: bytes) -> None:
    with FileServer(stalling(checkpoint, 1 << 15)) as server:
        with pytest.raises(DownloadError, match="nothing came for 3 s, after 32768 bytes"):
            fetch_from(server, folder, stall_s=3)  # long enough for the beginning on a busy machine
        assert unfinished(folder).stat().st_size == 1 << 15
        server.behaviour = sending_ranges(checkpoint)
        assert fetch_from(server, folder).path.read_bytes() == checkpoint


def test_a_server_that_says_nothing_at_all_is_not_waited_for(folder: Path) -> None:
    with (
        FileServer(lambda request: request.server.wait(request)) as server,
        pytest.raises(DownloadError, match=r"no answer \(timed out\)"),
    ):
        fetch_from(server, folder, stall_s=0.2)


def beginning_elsewhere(body: bytes, start: int) -> Behaviour:
    content_range = f"bytes {start}-{len(body) - 1}/{len(body)}"
    return lambda request: request.answer(body[start:], status=206, Content_Range=content_range)


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
        pytest.raises(DownloadError, match="asked from byte 0 on, got byte 50 on"),
    ):
        fetch_from(server, folder)


@pytest.mark.parametrize(
    ("body", "told"),
    [
        pytest.param(b"<!DOCTYPE html><title>Log in</title>", "found an HTML page", id="page of a portal"),
        pytest.param(b"", "the file is empty", id="nothing"),
        pytest.param(b"\0" * 5000, "the file is all zeros", id="zeros"),
        pytest.param(b"version https://git-lfs.github.com/spec/v1\n", "a Git LFS pointer", id="LFS"),
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
import resource
import sys
from pathlib import Path
from yolov5_lifecycle.commands.fetch_weights import fetch

def leave_little(done_bytes, total_bytes):
    if done_bytes == total_bytes:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + total_bytes // 4,) * 2)

fetch("n", Path(sys.argv[1]), url=sys.argv[2], progress=leave_little)
"""


def enlarged(checkpoint: bytes) -> bytes:
    """The same model in so many bytes that no heap has them in store; what is added is not looked at."""
    file = io.BytesIO(checkpoint)
    with zipfile.ZipFile(file, "a") as archive:
        folder = archive.namelist()[0].partition("/")[0]
        archive.writestr(f"{folder}/unused", bytes(40 << 20))
    return file.getvalue()


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited as Linux does")
def test_a_download_that_could_not_be_checked_for_want_of_memory_is_kept_and_taken_later(
    folder: Path, checkpoint: bytes
) -> None:
    large = enlarged(checkpoint)
    with FileServer(sending(large)) as server:
        command = [sys.executable, "-c", FETCHED_WITH_LITTLE_MEMORY, str(folder), server.address + PATTERN]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        assert "not enough memory to read it; free some. The download is kept" in run.stderr
        assert fetch_from(server, folder).path.stat().st_size == len(large)
    assert len(server.requests) == 1
    assert not unfinished(folder).exists()


@pytest.mark.parametrize("status", [403, 404, 500, 503])
def test_an_error_of_the_server_is_told_with_the_address_and_another_way(folder: Path, status: int) -> None:
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
        pytest.param(redirecting(f"ftp://{ESCAPES}"), "no answer", id="redirect"),
        pytest.param(redirecting(f"http://{ESCAPES}"), "", id="redirect to no host"),
        pytest.param(redirecting("http://127.0.0.1:99999999"), "no answer", id="redirect to no port"),
        pytest.param(
            sending(b"x", status=206, Content_Range=f"bytes {'9' * 5000}-"), "the range of a part", id="range"
        ),
        pytest.param(sending(b"x", status=206), "the range of a part", id="part without a range"),
        pytest.param(
            sending(b"x", status=206, Content_Range=ESCAPES), "the range of a part", id="range of escapes"
        ),
        pytest.param(
            sending(b"x", status=206, Content_Range="bytes \xb2-3/4"), "the range of a part", id="odd digit"
        ),
        pytest.param(chunked(b"-5\r\nhello"), "the connection broke", id="chunk of negative size"),
        pytest.param(chunked(b"-1\r\nhello"), "the connection broke", id="chunk of all that comes"),
        pytest.param(
            chunked(b"5\r\nhello\r\n", b"-1\r\n"), "the connection broke", id="negative chunk later"
        ),
        pytest.param(chunked(b"no number\r\n"), "the connection broke", id="chunk of no size"),
        pytest.param(chunked(b"f" * 5000 + b"\r\nhello"), "the connection broke", id="chunk of a huge size"),
        pytest.param(sending(b"", status=200), "the file is empty", id="empty"),
    ],
)
def test_whatever_a_server_answers_is_told_in_one_short_line_and_nothing_is_left(
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


@pytest.mark.parametrize("name", [".fetch_weights.lock", "yolov5n.partial.pt"])
@pytest.mark.parametrize("kind", ["link", "link to a pipe", "pipe", "folder"])
def test_what_is_no_file_is_neither_written_nor_waited_for(
    folder: Path, checkpoint: bytes, name: str, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    folder.mkdir(parents=True)
    precious = folder.parent / "precious"
    precious.write_bytes(b"precious")
    os.mkfifo(folder.parent / "pipe")
    if kind == "folder":
        (folder / name).mkdir()
    elif kind == "pipe":
        os.mkfifo(folder / name)
    else:
        (folder / name).symlink_to(folder.parent / {"link": "precious", "link to a pipe": "pipe"}[kind])
    with FileServer(sending(checkpoint)) as server:
        assert main(["n", "--dir", str(folder), "--url", server.address + PATTERN]) == 1
    assert str(folder / name) in capsys.readouterr().err
    assert precious.read_bytes() == b"precious"


def test_a_failed_download_leaves_no_empty_file(folder: Path) -> None:
    with FileServer(sending(b"", status=503)) as server, pytest.raises(DownloadError):
        fetch_from(server, folder)
    assert list(folder.glob("*.pt")) == []


@pytest.mark.parametrize("announced", [True, False], ids=["announced", "found out"])
def test_more_than_the_limit_is_not_taken(tmp_path: Path, announced: bool) -> None:
    def endless(request: ServedRequest) -> None:
        request.send_response(200)
        if announced:
            request.send_header("Content-Length", str(10**12))
        request.end_headers()
        with contextlib.suppress(OSError):
            while True:
                request.wfile.write(bytes(1 << 16))

    with FileServer(endless) as server, (tmp_path / "file").open("ab") as file:
        with pytest.raises(DownloadError, match="at most 1000000 are taken"):
            download(server.address, file, max_bytes=10**6, stall_s=20, progress=lambda *_: None)
        assert file.tell() <= 10**6 + (1 << 14)


@pytest.mark.parametrize(
    ("url", "told"),
    [
        pytest.param("http://[/{size}.pt", "Invalid IPv6 URL", id="no address"),
        pytest.param("file:///etc/{size}", "begins with https:// or http://", id="another scheme"),
        pytest.param("yolov5{size}.pt", "begins with https:// or http://", id="no scheme"),
        pytest.param("http://127.0.0.1/yolov5n.pt", "with {size} in it", id="no place for the size"),
    ],
)
def test_an_address_that_cannot_be_used_is_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], url: str, told: str
) -> None:
    assert main(["n", "--dir", str(folder), "--url", url]) == 1
    _licence, line = capsys.readouterr().err.splitlines()
    assert line.startswith("fetch_weights: ")
    assert told in line


def test_a_server_that_is_not_there_is_told(folder: Path) -> None:
    with socket.socket() as deaf:
        deaf.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{deaf.getsockname()[1]}/{{size}}.pt"
        with pytest.raises(
            DownloadError, match=r"no answer \(.*refused\); check the address and the network"
        ):
            fetch("n", folder, url=url)


def test_two_at_a_time_do_not_mix_their_files(folder: Path, checkpoint: bytes) -> None:
    def second(request: ServedRequest) -> None:
        with pytest.raises(DownloadError, match="another fetch_weights is at work"):
            fetch_from(server, folder)
        sending(checkpoint)(request)

    with FileServer(second) as server:
        assert fetch_from(server, folder).path.read_bytes() == checkpoint
    assert len(server.requests) == 1


def test_a_disk_that_cannot_be_written_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["n", "--dir", "/proc/nowhere"]) == 1
    assert "/proc/nowhere" in capsys.readouterr().err


def test_the_command_tells_the_licence_once_and_then_the_facts(
    folder: Path,
    checkpoint: bytes,
    digest: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with FileServer(sending(checkpoint)) as server:
        monkeypatch.setenv("YOLOV5_WEIGHTS_URL", server.address + PATTERN)
        assert main(["n", "--dir", str(folder), "--sha256", digest.upper()]) == 0
    told = capsys.readouterr()
    assert told.err.count("AGPL-3.0") == told.err.count("\n") == 1
    assert told.out.splitlines()[0] == str(folder / "yolov5n.pt")
    assert told.out.splitlines()[-1] == f"sha256      {digest}"


def test_the_option_wins_over_the_environment(
    folder: Path, checkpoint: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("YOLOV5_WEIGHTS_URL", "http://nowhere.invalid/{size}")
    with FileServer(sending(checkpoint)) as server:
        assert main(["n", "--dir", str(folder), "--url", server.address + PATTERN]) == 0


def test_on_request_a_safetensors_file_lies_beside_it(folder: Path, checkpoint: bytes) -> None:
    with FileServer(sending(checkpoint)) as server:
        arguments = ["n", "--dir", str(folder), "--url", server.address + PATTERN, "--safetensors"]
        assert main(arguments) == 0
        assert main(arguments) == 0, "the second time everything is there"
    converted = find_weights(weights="", weights_dir=folder, model_size="n")
    assert converted == folder / "yolov5n.safetensors"
    assert load_weights(converted).model.class_names == CLASS_NAMES
    assert len(server.requests) == 1


def test_a_terminal_sees_the_progress(
    folder: Path, checkpoint: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    master, terminal = pty.openpty()
    with (
        FileServer(sending(checkpoint)) as server,
        os.fdopen(terminal, "w", buffering=1) as stderr,
        monkeypatch.context() as patch,
    ):
        patch.setattr(sys, "stderr", stderr)
        assert main(["n", "--dir", str(folder), "--url", server.address + PATTERN]) == 0
    told = os.read(master, 1 << 16).decode()
    os.close(master)
    assert f"{len(checkpoint) / 1e6:.1f} of {len(checkpoint) / 1e6:.1f} MB" in told


def test_the_list_shows_what_is_there(
    folder: Path, checkpoint: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--list", "--dir", str(folder)]) == 0
    assert capsys.readouterr().out.startswith(f"no weights in {folder}; `fetch_weights n")
    folder.mkdir(parents=True)
    (folder / "yolov5n.pt").write_bytes(bytes(3_900_000))
    unfinished(folder).touch()
    (folder / "notes.txt").touch()
    assert main(["--list", "--dir", str(folder)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"     0.0 MB  {unfinished(folder)}  (unfinished: fetch it again)",
        f"     3.9 MB  {folder}/yolov5n.pt",
    ]


@pytest.mark.parametrize("digest", ["abc", "g" * 64], ids=["too short", "no digits"])
def test_a_digest_that_is_none_is_refused_before_anything_is_downloaded(
    folder: Path, checkpoint: bytes, capsys: pytest.CaptureFixture[str], digest: str
) -> None:
    with FileServer(sending(checkpoint)) as server, pytest.raises(SystemExit) as stopped:
        main(["n", "--dir", str(folder), "--url", server.address + PATTERN, "--sha256", digest])
    assert stopped.value.code == 2
    assert "must be 64 hexadecimal digits" in capsys.readouterr().err
    assert server.requests == []


@pytest.mark.parametrize(
    "arguments", [[], ["n", "--list"], ["huge"], ["n", "s"], ["n", "--unknown"]], ids=str
)
def test_wrong_usage_is_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("fetch_weights: ")
