"""The command `fetch_weights`: its arguments, what it prints, and the files it writes."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.checkpoint_builder import official_model, saved, stripped
from support.file_server import (
    PATTERN,
    FileServer,
    ServedRequest,
    fetch_from,
    sending,
    sending_ranges,
    unfinished,
)
from support.random_model import CLASS_NAMES, random_model
from support.refusals import Refused
from support.small_families import SMALL_FAMILIES

from yolov5_lifecycle.checkpoints.locate import find_weights, load_weights
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.commands.download import DownloadError
from yolov5_lifecycle.commands.fetch_weights import MODELS, SHA256, main
from yolov5_lifecycle.models.model import WeightsError
from yolov5_lifecycle.ros.child_process import entry_point


def test_the_file_of_the_size_comes_to_where_the_detector_looks_and_is_told_with_its_licence(
    tmp_path: Path,
    checkpoint: bytes,
    digest: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "ros" / "yolov5"  # not there yet
    with FileServer(sending_ranges(checkpoint)) as server:
        monkeypatch.setenv("YOLOV5_WEIGHTS_URL", server.address + PATTERN)
        assert main(["n", "--dir", str(folder), "--sha256", digest.upper()]) == 0
    assert server.requests == [("/releases/yolov5n.pt", "")]
    path = find_weights(weights="", weights_dir=folder, model_size="n")
    assert path.read_bytes() == checkpoint
    assert not unfinished(folder).exists()
    told = capsys.readouterr()
    assert told.err.count("AGPL-3.0") == told.err.count("\n") == 1
    assert told.out.splitlines()[0] == str(path)
    assert told.out.splitlines()[-1] == f"sha256      {digest}"


def test_a_model_that_segments_comes_under_its_own_name_and_is_said_not_to_be_checked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = official_model(SMALL_FAMILIES["segmentation"], kind="models.yolo.SegmentationModel")
    with FileServer(sending_ranges(saved(stripped(model)))) as server:
        assert main(["n-seg", "--dir", str(tmp_path), "--url", server.address + PATTERN]) == 0
    assert server.requests == [("/releases/yolov5n-seg.pt", "")]
    first, *_, last = capsys.readouterr().out.splitlines()
    assert first == str(tmp_path / "yolov5n-seg.pt")
    assert load_weights(Path(first)).model.architecture.mask_coefficients == 8
    told = "official    not checked: the sha256 of yolov5n-seg.pt is not known here; --sha256 checks it"
    assert last == told


def test_a_file_that_is_there_is_not_asked_for_again(tmp_path: Path, checkpoint: bytes, digest: str) -> None:
    (tmp_path / "yolov5n.pt").write_bytes(checkpoint)
    with FileServer(sending(b"")) as server:
        assert fetch_from(server, tmp_path, sha256=digest).sha256 == digest
        with pytest.raises(WeightsError, match=f"its sha256 is {digest}, expected {'0' * 64}"):
            fetch_from(server, tmp_path, sha256="0" * 64)
    assert server.requests == []
    assert (tmp_path / "yolov5n.pt").exists()


@pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
def test_what_is_no_file_is_neither_written_nor_waited_for(
    tmp_path: Path, checkpoint: bytes, kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "yolov5n.partial.pt"
    precious = tmp_path / "precious"
    precious.write_bytes(b"precious")
    if kind == "folder":
        (tmp_path / name).mkdir()
    elif kind == "pipe":
        os.mkfifo(tmp_path / name)
    else:
        (tmp_path / name).symlink_to(precious)
    with FileServer(sending(checkpoint)) as server:
        assert main(["n", "--dir", str(tmp_path), "--url", server.address + PATTERN]) == 1
    assert str(tmp_path / name) in capsys.readouterr().err
    assert precious.read_bytes() == b"precious"


@pytest.mark.parametrize(
    ("url", "told"),
    [
        pytest.param("http://[/{size}.pt", "Invalid IPv6 URL", id="no address"),
        pytest.param("file:///etc/{size}", "begins with https:// or http://", id="another scheme"),
        pytest.param("http://127.0.0.1/yolov5n.pt", "with {size} in it", id="no place for the size"),
    ],
)
def test_an_address_that_cannot_be_used_is_one_line(
    tmp_path: Path, refused: Refused, url: str, told: str
) -> None:
    _licence, line = refused(main, "n", "--dir", tmp_path, "--url", url).splitlines()
    assert line.startswith("fetch_weights: ")
    assert told in line


def test_two_at_a_time_do_not_mix_their_files(tmp_path: Path, checkpoint: bytes) -> None:
    def second(request: ServedRequest) -> None:
        with pytest.raises(DownloadError, match="another fetch_weights is running"):
            fetch_from(server, tmp_path)
        sending(checkpoint)(request)

    with FileServer(second) as server:
        assert fetch_from(server, tmp_path).path.read_bytes() == checkpoint
    assert len(server.requests) == 1


def test_on_request_a_safetensors_file_lies_beside_it(tmp_path: Path, checkpoint: bytes, digest: str) -> None:
    words = ["n", "--dir", str(tmp_path), "--sha256", digest, "--safetensors"]
    with FileServer(sending(checkpoint)) as server:
        arguments = [*words, "--url", server.address + PATTERN]
        assert main(arguments) == 0
        assert main(arguments) == 0, "the second time everything is there"
    converted = find_weights(weights="", weights_dir=tmp_path, model_size="n")
    assert converted == tmp_path / "yolov5n.safetensors"
    assert load_weights(converted).model.class_names == CLASS_NAMES
    assert len(server.requests) == 1


def test_another_safetensors_file_of_that_name_stays(
    tmp_path: Path, checkpoint: bytes, digest: str, refused: Refused
) -> None:
    (tmp_path / "yolov5n.pt").write_bytes(checkpoint)
    mine = tmp_path / "yolov5n.safetensors"
    write_safetensors(random_model(7), mine)
    told = refused(main, "n", "--dir", tmp_path, "--sha256", digest, "--safetensors")
    assert f"`convert --force {tmp_path / 'yolov5n.pt'} {mine}`" in told


def test_a_damaged_file_that_was_there_before_is_refused_with_what_to_remove(
    tmp_path: Path, checkpoint: bytes, refused: Refused
) -> None:
    (tmp_path / "yolov5n.pt").write_bytes(checkpoint[:1000])
    for words in ((), ("--sha256", "0" * 64)):
        told = refused(main, "n", "--dir", tmp_path, *words)
        assert f"{tmp_path / 'yolov5n.pt'}: " in told
        assert "remove it to have it downloaded" in told


def test_a_mirror_with_another_file_than_the_official_one_is_refused(
    tmp_path: Path, checkpoint: bytes, digest: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with FileServer(sending(checkpoint)) as server:
        assert main(["n", "--dir", str(tmp_path), "--url", server.address + PATTERN]) == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert f"its sha256 is {digest}, expected {SHA256['n']}" in told
    assert "that of yolov5n.pt in release v7.0: for another file that you trust" in told
    assert list(tmp_path.glob("*.pt")) == []


def test_the_official_digests_are_of_official_models_and_all_different() -> None:
    assert "n6-seg" not in MODELS
    assert set(SHA256) == {model for model in MODELS if not model.endswith("-seg")}
    assert len(set(SHA256.values())) == len(SHA256)
    assert all(re.fullmatch(r"[0-9a-f]{64}", digest) for digest in SHA256.values())


def test_a_terminal_sees_the_progress(
    tmp_path: Path, checkpoint: bytes, digest: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    master, terminal = pty.openpty()
    with (
        FileServer(sending(checkpoint)) as server,
        os.fdopen(terminal, "w", buffering=1) as stderr,
        monkeypatch.context() as patch,
    ):
        patch.setattr(sys, "stderr", stderr)
        words = ["n", "--dir", str(tmp_path), "--sha256", digest]
        assert main([*words, "--url", server.address + PATTERN]) == 0
    told = os.read(master, 1 << 16).decode()
    os.close(master)
    assert f"{len(checkpoint) / 1e6:.1f} of {len(checkpoint) / 1e6:.1f} MB" in told


def test_a_digest_that_is_none_is_refused_before_anything_is_downloaded(
    tmp_path: Path, checkpoint: bytes, refused: Refused
) -> None:
    with FileServer(sending(checkpoint)) as server:
        words = ["n", "--dir", tmp_path, "--url", server.address + PATTERN, "--sha256", "abc"]
        line = refused.in_a_line(main, *words, code=2)
    assert line.startswith("fetch_weights: ")
    assert "must be 64 hexadecimal digits" in line
    assert ".." not in line
    assert server.requests == []


@pytest.mark.end_to_end
def test_the_command_resumes_what_was_cut_and_ends_with_a_file_that_the_detector_finds(
    tmp_path: Path, checkpoint: bytes, digest: str
) -> None:
    command = [entry_point("fetch_weights"), "n", "--dir", str(tmp_path), "--sha256", digest, "--safetensors"]
    with FileServer(sending(checkpoint[:5000], length=len(checkpoint))) as server:
        command += ["--url", server.address + PATTERN]
        cut = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert (cut.returncode, cut.stdout) == (1, "")
        assert "ended after 5000 of" in cut.stderr
        server.behaviour = sending_ranges(checkpoint)
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    assert server.requests[1] == ("/releases/yolov5n.pt", "bytes=5000-")
    found = find_weights(weights="", weights_dir=tmp_path, model_size="n")
    assert done.stdout.splitlines()[0] == str(found) == str(tmp_path / "yolov5n.safetensors")
