"""Which weights file is taken, and what is said of one that cannot be."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from support.random_model import CLASS_NAMES, random_model

from yolov5_lifecycle.checkpoints.locate import (
    MAX_FILE_BYTES,
    find_weights,
    is_out_of_memory,
    load_weights,
    weights_digest,
)
from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
from yolov5_lifecycle.models.model import WeightsError
from yolov5_lifecycle.printable import in_one_line

_ANYWHERE: dict[str, Any] = {"weights_dir": Path("/"), "model_size": "n"}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "good.safetensors"
    write_safetensors(random_model(), path)
    return path


def refusal(path: Path, **options: str) -> str:
    with pytest.raises(WeightsError) as refused:
        load_weights(path, **options)
    return str(refused.value)


@pytest.mark.parametrize(
    ("present", "chosen"),
    [
        pytest.param(["yolov5s.pt", "yolov5s.safetensors"], "yolov5s.safetensors", id="both"),
        pytest.param(["yolov5s.pt", "yolov5n.safetensors"], "yolov5s.pt", id="another size beside it"),
    ],
)
def test_without_a_path_the_file_of_the_size_is_taken(
    tmp_path: Path, present: list[str], chosen: str
) -> None:
    for name in present:
        (tmp_path / name).touch()
    assert find_weights(weights="", weights_dir=tmp_path, model_size="s") == tmp_path / chosen


def test_a_tilde_is_the_home_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "yolov5n.pt").touch()
    assert find_weights(weights="~/a.pt", weights_dir=Path("/"), model_size="n") == tmp_path / "a.pt"
    assert find_weights(weights="", weights_dir=Path("~"), model_size="n") == tmp_path / "yolov5n.pt"


@pytest.mark.parametrize(
    ("weights", "folder"), [("~nobody-of-that-name/a.pt", "/"), ("", "~nobody-of-that-name")], ids=str
)
def test_a_home_folder_that_does_not_exist_is_refused(weights: str, folder: str) -> None:
    with pytest.raises(WeightsError, match="no such home folder"):
        find_weights(weights=weights, weights_dir=Path(folder), model_size="n")


def test_when_nothing_is_found_both_paths_and_the_remedy_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "my models"
    with pytest.raises(WeightsError) as refused:
        find_weights(weights="", weights_dir=folder, model_size="m6")
    message = str(refused.value)
    for part in (folder / "yolov5m6.safetensors", folder / "yolov5m6.pt", "`weights`"):
        assert str(part) in message
    assert f"`fetch_weights m6 --dir '{folder}'`" in message


def test_a_dangling_link_is_found_and_then_reported(tmp_path: Path) -> None:
    (tmp_path / "yolov5n.pt").symlink_to(tmp_path / "gone.pt")
    path = find_weights(weights="", weights_dir=tmp_path, model_size="n")
    assert path == tmp_path / "yolov5n.pt"
    assert "no such file" in refusal(path)


def test_a_file_is_what_its_bytes_say_whatever_its_suffix_or_a_link(good: Path, tmp_path: Path) -> None:
    link = tmp_path / "LINK.SAFETENSORS"
    link.symlink_to(good)
    loaded = load_weights(link)
    assert loaded.path == good
    assert loaded.sha256 == hashlib.sha256(good.read_bytes()).hexdigest()
    assert loaded.model.class_names == CLASS_NAMES


@pytest.mark.parametrize(
    "url", ["HTTPS://Mirror.example/YOLOv5S6.PT", "https://me:secret@host/best.pt?raw=1", "file:///home/a.pt"]
)
@pytest.mark.parametrize(
    "look",
    [
        pytest.param(lambda url: load_weights(Path(url)), id="load"),
        pytest.param(lambda url: weights_digest(Path(url)), id="digest"),
        pytest.param(lambda url: find_weights(weights=url, **_ANYWHERE), id="find"),
        pytest.param(
            lambda url: find_weights(weights=url, weights_dirs=[Path("/opt")], **_ANYWHERE), id="confined"
        ),
    ],
)
def test_a_url_is_answered_with_what_to_type(url: str, look: Callable[[str], object]) -> None:
    with pytest.raises(WeightsError) as refused:
        look(url)
    message = in_one_line(str(refused.value))
    assert message.startswith(url) or "secret" in url
    assert "this is a URL, and a path is expected: download it" in message
    assert "`fetch_weights n` downloads an official model" in message
    assert "secret" not in message


def test_the_digest_of_a_file_is_that_of_its_bytes_with_or_without_one_to_compare(good: Path) -> None:
    digest = hashlib.sha256(good.read_bytes()).hexdigest()
    for written in (digest, digest.upper()):
        assert weights_digest(good) == weights_digest(good, sha256=written) == digest
        assert load_weights(good, sha256=written).sha256 == digest
    for look in (weights_digest, load_weights):
        with pytest.raises(WeightsError, match=f"{digest}, expected 00.*another file; get the right one"):
            look(good, sha256="0" * 64)


def test_the_digest_is_checked_before_anything_is_read_out_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "broken.pt"
    path.write_bytes(b"PK\x03\x04 and nothing that could be read")
    assert "sha256" in refusal(path, sha256="0" * 64)


def _too_large(path: Path) -> None:
    path.touch()
    os.truncate(path, MAX_FILE_BYTES + 1)


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        pytest.param("no/a.pt", lambda path: None, "no such file: check the path for a", id="missing"),
        pytest.param("$HOME/a.pt", lambda path: None, "$HOME are not replaced here: write ~", id="variable"),
        pytest.param("a  b.pt", lambda path: None, "the path has blanks at its beg", id="blanks"),
        pytest.param("a.pt", Path.mkdir, "expected a regular file, found a folder", id="folder"),
        pytest.param("a.pt", os.mkfifo, "expected a regular file", id="pipe"),
        pytest.param("a.pt", lambda path: path.symlink_to("/dev/zero"), "expected a regular", id="endless"),
        pytest.param("a.pt", lambda path: path.symlink_to("/proc/version"), "changed while", id="no size"),
        pytest.param(
            "a.pt", lambda path: path.symlink_to(path), "cannot be read (Too many levels", id="link to itself"
        ),
        pytest.param("a.pt", _too_large, "at most 2147483648 are read", id="too large"),
        pytest.param("a.pt/b.pt", lambda path: path.parent.touch(), "Not a directory", id="file as folder"),
        pytest.param(f"{'a' * 300}.pt", lambda path: None, "File name too long", id="name too long"),
        pytest.param("a\0.pt", lambda path: None, "NUL character", id="NUL"),
        pytest.param("a.pt", Path.touch, "the file is empty", id="empty pt"),
        pytest.param("a.onnx", Path.touch, "no ONNX model (it has no graph)", id="empty onnx"),
        pytest.param("a.ENGINE", Path.touch, "is a TensorRT export: use the .pt", id="export"),
        pytest.param(
            "a.txt", Path.touch, "ends in .safetensors, .pt, .pth, .onnx, found '.txt'", id="suffix"
        ),
    ],
)
def test_a_file_that_cannot_be_used_is_refused(
    tmp_path: Path, name: str, make: Callable[[Path], None], message: str
) -> None:
    path = tmp_path / name
    make(path)
    told = refusal(path)
    assert told.startswith(f"{path}: ")
    assert told.endswith(".")
    assert message in told


def test_a_file_that_was_written_to_meanwhile_is_refused(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As soon as the file system's clock tells: 4 ms later, on many."""
    times = itertools.count()
    real = os.fstat

    def touched(descriptor: int) -> os.stat_result:
        os.utime(descriptor, (0, next(times)))
        return real(descriptor)

    monkeypatch.setattr(os, "fstat", touched)
    assert "changed while it was read" in refusal(good)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_without_permission_is_refused(good: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.safetensors"
    secret.write_bytes(good.read_bytes())
    secret.chmod(0)
    assert "Permission denied" in refusal(secret)


def test_a_refused_file_leaves_no_file_open(good: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.pt")
    before = len(list(Path("/proc/self/fd").iterdir()))
    refusal(tmp_path / "pipe.pt")
    refusal(good, sha256="0" * 64)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def fail(error: Exception) -> None:
    raise error


def hide_a_shortage() -> None:
    """As zipfile does, which then finds a file closed."""
    try:
        raise MemoryError
    finally:
        raise ValueError("I/O operation on closed file")


@pytest.mark.parametrize(
    ("fail", "is_shortage"),
    [
        pytest.param(lambda: fail(MemoryError()), True, id="Python's"),
        pytest.param(hide_a_shortage, True, id="behind another error"),
        pytest.param(lambda: torch.empty(1 << 60, dtype=torch.uint8), True, id="torch's"),
        pytest.param(lambda: torch.empty(-1), False, id="another of torch"),
        pytest.param(lambda: fail(WeightsError("damaged")), False, id="damage"),
        pytest.param(
            lambda: fail(WeightsError("no tensor 'can't allocate memory'")), False, id="damage that says so"
        ),
    ],
)
def test_a_lack_of_memory_is_distinguished_from_damage(fail: Callable[[], object], is_shortage: bool) -> None:
    with pytest.raises(Exception) as raised:  # noqa: PT011 - of any kind
        fail()
    assert is_out_of_memory(raised.value) is is_shortage
