"""Unfinished files and folders are removed once the process that owns them is dead, and never before."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY
from support.started import started

from yolov5_lifecycle.atomic_file import (
    FOLDER_PREFIX,
    OutputError,
    atomic_write,
    hold,
    remove_abandoned_folders,
    temporary_folder,
    whole_output,
    write_together,
)

WRITER = """
import sys
from pathlib import Path
from yolov5_lifecycle.atomic_file import whole_output
with whole_output(Path(sys.argv[1], "drive")) as unfinished:
    (unfinished / "images").mkdir(parents=True)
    (unfinished / "images" / "0.png").write_bytes(bytes(1000))
    print(unfinished, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def abandoned(folder: Path, name: str) -> Path:
    path = folder / f"{FOLDER_PREFIX}{name}"
    path.mkdir()
    (path / "optimized.onnx").write_bytes(b"x")
    return path


@contextmanager
def holding(folder: Path) -> Iterator[tuple[subprocess.Popen[str], Path]]:
    """A process, and what it writes into `folder` until its standard input ends."""
    with started(
        [sys.executable, "-c", WRITER, folder],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
    ) as owner:
        assert owner.stdout is not None
        yield owner, Path(owner.stdout.readline().strip())


def test_the_output_of_a_killed_process_is_removed_by_the_next_and_that_of_a_living_one_is_not(
    folder: Path,
) -> None:
    users_own = folder / ".unfinished-novel" / "chapters"
    users_own.mkdir(parents=True)
    with holding(folder) as (owner, unfinished):
        with whole_output(folder / "first") as path:
            path.touch()
        assert (unfinished / "images" / "0.png").exists()
        owner.send_signal(signal.SIGKILL)
        owner.wait()
        assert (unfinished / "images" / "0.png").exists()
        with whole_output(folder / "second") as path:
            path.touch()
    assert sorted(path.name for path in folder.iterdir()) == [".unfinished-novel", "first", "second"]
    assert users_own.is_dir()


def fail_to_write(output: Path, what_happens: Callable[[], object]) -> None:
    with whole_output(output) as path:
        (path / "images").mkdir(parents=True)
        what_happens()


def test_an_output_that_fails_leaves_nothing(folder: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        fail_to_write(folder / "drive", lambda: signal.raise_signal(signal.SIGINT))
    assert list(folder.iterdir()) == []


def test_an_output_that_somebody_else_has_made_meanwhile_is_not_replaced(folder: Path) -> None:
    output = folder / "output"
    with pytest.raises(OutputError, match="exists and is not replaced"):
        fail_to_write(output, lambda: output.write_text("theirs"))
    assert [path.read_text() for path in folder.iterdir()] == ["theirs"]


def test_other_things_of_that_name_are_left_alone(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    precious = tmp_path_factory.mktemp("precious") / "file"
    precious.write_bytes(b"x")
    (folder / f"{FOLDER_PREFIX}link").symlink_to(precious.parent)
    os.mkfifo(folder / f"{FOLDER_PREFIX}fifo")
    (folder / "other").mkdir()
    inside = abandoned(folder, "with-a-link")
    (inside / "link").symlink_to(precious)
    remove_abandoned_folders()
    assert sorted(path.name for path in folder.iterdir()) == [
        f"{FOLDER_PREFIX}fifo", f"{FOLDER_PREFIX}link", "other",
    ]  # fmt: skip
    assert precious.read_bytes() == b"x"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to another user")
def test_the_folder_of_another_user_is_left_alone(folder: Path) -> None:
    other = abandoned(folder, "other")
    os.chown(other, 65534, 65534)
    remove_abandoned_folders()
    assert other.is_dir()


def test_a_machine_without_a_folder_for_temporary_files_has_nothing_to_remove(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    remove_abandoned_folders()
    with pytest.raises(FileNotFoundError), temporary_folder():
        pass


def test_a_file_is_locked_by_one_owner_and_only_at_its_path(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with path.open("wb") as first, path.open("rb") as second:
        assert hold(first.fileno(), path)
        assert not hold(second.fileno(), path)
    with path.open("rb") as third:
        path.rename(tmp_path / "elsewhere")
        assert not hold(third.fileno(), path)
        path.touch()
        assert not hold(third.fileno(), path), "another file has its name now"


def test_a_file_is_whole_while_others_remove_what_is_abandoned(tmp_path: Path) -> None:
    abandoned(tmp_path, "old")
    (tmp_path / "file").write_bytes(b"0")
    before = os.umask(0o077)  # of a careful user; others may read the file all the same
    try:
        atomic_write(tmp_path / "file", b"1", b"2")
    finally:
        os.umask(before)
    remove_abandoned_folders(tmp_path)
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("file", b"12")]
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o644


def test_files_that_belong_together_are_all_written_or_none(tmp_path: Path) -> None:
    (tmp_path / "one").write_bytes(b"before")
    with pytest.raises(FileNotFoundError):
        write_together({tmp_path / "one": b"1", tmp_path / "no folder" / "two": b"2"})
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("one", b"before")]
    write_together({tmp_path / "one": b"1", tmp_path / "two": b"2"})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"one": b"1", "two": b"2"}
