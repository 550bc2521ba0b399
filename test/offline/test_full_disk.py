"""Output that cannot be written completely: the command ends with the reason and leaves nothing behind.

A limit on the size of files stands for a full disk, which only root could provide: a write that exceeds it
fails, with EFBIG in place of ENOSPC.
"""

from __future__ import annotations

import errno
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin
from support.detected_offline import SET_MODEL
from support.grey_images import grey_folder
from support.recorded_scene import COUNT, raw, record, video

from yolov5_lifecycle.offline.detect_recording import os_errors

# Python would keep truncated bytecode of this package: https://github.com/python/cpython/issues/126606.
LIMITED = (
    "import resource, sys; sys.dont_write_bytecode = True; "
    "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY)); "
    "from yolov5_lifecycle.offline.detect_bag import main; sys.exit(main(sys.argv[2:]))"
)


def limited(max_bytes: int, *words: object) -> subprocess.CompletedProcess[str]:
    """The command in a process that cannot write files of more than `max_bytes`."""
    command = [sys.executable, "-c", LIMITED, str(max_bytes), *map(str, words), *SET_MODEL]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.long
@pytest.mark.parametrize(
    ("storage", "told"),
    [
        pytest.param(StoragePlugin.MCAP, "File too large", id="MCAP"),
        pytest.param(StoragePlugin.SQLITE3, "disk I/O error: '", id="SQLite"),
    ],
)
def test_a_recording_that_cannot_be_written_leaves_nothing(
    storage: StoragePlugin, told: str, tmp_path: Path
) -> None:
    source = record(tmp_path / "drive", [raw(number) for number in range(COUNT)], storage=storage)
    ended = limited(100_000, source, "--images", "--output", tmp_path / "found")
    assert ended.returncode == 1
    assert told in ended.stderr
    assert "Traceback" not in ended.stderr
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.long
@pytest.mark.parametrize(
    "suffix",
    [".jpg", *(pytest.param(suffix, marks=pytest.mark.long) for suffix in (".png", ".bmp", ".webp", ".tif"))],
)
def test_a_small_annotated_image_that_cannot_be_written_leaves_nothing(suffix: str, tmp_path: Path) -> None:
    """Small enough for the buffer of a C program, which then fails only when it closes the file."""
    source = grey_folder(tmp_path) / "8.png"
    before = sorted(tmp_path.iterdir())
    ended = limited(20, source, "--annotated", tmp_path / f"drawn{suffix}")
    assert ended.returncode == 1
    assert "File too large" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.long
@pytest.mark.parametrize("max_bytes", [6_000, pytest.param(20_000, marks=pytest.mark.long)])
@pytest.mark.parametrize("suffix", [".avi", ".mp4"])
def test_an_annotated_video_that_cannot_be_written_leaves_nothing(
    suffix: str, max_bytes: int, tmp_path: Path
) -> None:
    source, drawn = video(tmp_path / "drive.avi"), tmp_path / f"drawn{suffix}"
    ended = limited(max_bytes, source, "--annotated", drawn, "--output", tmp_path / "found.jsonl")
    assert ended.returncode == 1
    assert f"detect_bag: drawn{suffix}: " in ended.stderr
    assert "is the disk full?" in ended.stderr
    assert "Traceback" not in ended.stderr
    assert list(tmp_path.iterdir()) == [source]


def test_a_full_disk_is_one_in_sqlite_too(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "small.db3") as connection:
        connection.execute("PRAGMA max_page_count = 2")
        connection.execute("CREATE TABLE messages(data BLOB)")
        with pytest.raises(OSError, match=r"small\.db3") as raised, os_errors(tmp_path / "small.db3"):
            connection.execute("INSERT INTO messages VALUES(zeroblob(1000000))")
    connection.close()
    assert raised.value.errno == errno.ENOSPC
