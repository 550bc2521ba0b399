"""Errors of `detect_bag`: each has a reason, and nothing half-written is left behind."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from rosbags.rosbag2 import StoragePlugin
from support.detected_offline import SET_MODEL, prepare_raising, run
from support.grey_images import grey_folder
from support.recorded_scene import images, raw, record, text, video
from support.refusals import Refused

from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError

SQLITE = StoragePlugin.SQLITE3


@pytest.mark.parametrize(
    ("error", "failures"),
    [
        pytest.param(InferenceError("out of memory"), 2, id="again and again"),
        pytest.param(DeviceLostError("the GPU is gone"), 1, id="device lost"),
    ],
)
def test_detection_ends_after_too_many_failed_inferences(
    error: InferenceError, failures: int, drive: Path, refused: Refused
) -> None:
    raising = partial(main, prepare=prepare_raising(error))
    told = refused(raising, drive, "--output", "found", "--set", "max_consecutive_failures=2")
    assert told.endswith(f"detect_bag: stopped after {failures} consecutive failed images: {error}\n")


def no_images(folder: Path) -> Path:
    return record(folder / "bag", [text()], topics=["/chatter"])


def two_topics(folder: Path) -> Path:
    return record(folder / "bag", [raw(0)], topics=["/left", "/right"])


def all_unreadable(folder: Path) -> Path:
    return record(folder / "bag", [raw(0, encoding="32FC1")], storage=SQLITE)


def with_damaged_pages(folder: Path) -> Path:
    """A database that opens, and breaks when its messages are read."""
    bag = record(folder / "bag", storage=SQLITE)
    with (bag / "bag.db3").open("r+b") as file:
        file.seek(60_000)
        file.write(b"\xff" * 500_000)
    return bag


def a_good_one(folder: Path) -> Path:
    return record(folder / "bag")


def many(folder: Path) -> Path:
    """A folder of recordings, beside another one."""
    (folder / "drives").mkdir()
    record(folder / "other", [raw(0)])
    for name in ("drives/a.mcap", "drives/b.mcap", "bag.mcap"):
        (folder / name).touch()
    return folder / "drives"


@pytest.mark.parametrize(
    ("make", "words", "told"),
    [
        pytest.param(no_images, [], "only: /chatter (std_msgs/msg/String, cdr). Record", id="no images"),
        pytest.param(
            two_topics, [], "one of its image topics with --topic:\n  /left  sensor", id="two topics"
        ),
        pytest.param(
            two_topics,
            ["--topic", "/up"],
            "no image topic /up; choose one of these:\n  /left",
            id="no such topic",
        ),
        pytest.param(
            all_unreadable,
            [],
            "none of 1 images could be used, the first: Encoding '32FC1'",
            id="all unreadable",
        ),
        pytest.param(
            lambda folder: record(folder / "bag", []), [], "has no messages. Did the camera", id="no messages"
        ),
        pytest.param(with_damaged_pages, [], "the recording cannot be read", id="damaged pages"),
        pytest.param(a_good_one, ["--output", "bag"], "exists and is not replaced", id="output exists"),
        pytest.param(a_good_one, ["--output", "no/x"], "folder not found; create it", id="no folder"),
        pytest.param(a_good_one, ["--set", "classes=[circel]"], "Did you mean 'circle'?", id="class"),
        pytest.param(a_good_one, ["--set", "conf=0.4"], "'confidence_threshold'?", id="setting"),
        pytest.param(many, ["--output", "no/x"], "folder not found; create it", id="no folder for many"),
        pytest.param(many, ["--output", "bag.mcap"], "bag.mcap is not a folder", id="file for many"),
        pytest.param(many, ["--output", "other"], "other is a recording: choose", id="recording for many"),
        pytest.param(many, ["--set", "weights_sha256=" + "f" * 64], "its sha256 is", id="digest"),
        pytest.param(a_good_one, ["--params-file", "no.yaml"], "no.yaml", id="no parameter file"),
    ],
)
def test_an_error_says_what_to_do_and_leaves_nothing_behind(
    make: Callable[[Path], Path], words: list[str], told: str, tmp_path: Path, refused: Refused
) -> None:
    error = refused(run, make(tmp_path), "--output", "found", *SET_MODEL, *words)
    assert error.startswith("detect_bag: ")
    assert told in error


@pytest.mark.parametrize(
    ("words", "told"),
    [
        pytest.param(
            ["drive.avi", "--images", "--topic", "/x", "--output", "x.yolo", "--track"],
            [
                "--topic applies to recordings only",
                "--images applies to recordings only",
                ".yolo has no ids of tracks",
            ],
            id="video",
        ),
        pytest.param(
            ["drive", "--annotated", "x.mp4", "--images", "--output", "x.csv"],
            ["for recordings use --images", "--images needs a recording as output"],
            id="recording",
        ),
        pytest.param(
            ["shots", "--track", "--crops"],
            ["shots has still images; tracking needs", "--crops needs --output"],
            id="images",
        ),
        pytest.param(
            ["drive", "drive.avi", "--annotated", "x"],
            ["give --output, the folder for the results", "--annotated applies to a single video"],
            id="many",
        ),
        pytest.param(["drive"], ["give --output, the new recording to write"], id="no output"),
        pytest.param(
            ["drive", "--output", "x", "--node", "a b"], ["expected the full name of a node"], id="node"
        ),
        pytest.param(
            ["drive.avi", "--jobs", "2", "--output", "x", "--images", "--topic", "/x"],
            ["--topic applies to recordings only; --images"],
            id="many videos",
        ),
        pytest.param(["a", "--jobs", "0"], ["expected a number of processes from 1 to"], id="no jobs"),
        pytest.param(["a", "--jobs", "many"], [", found 'many'"], id="no number of jobs"),
        pytest.param([], ["SOURCE"], id="nothing"),
    ],
)
def test_all_arguments_that_are_wrong_are_told_at_once_in_one_line(
    words: list[str], told: list[str], drive: Path, refused: Refused
) -> None:
    images(drive.parent / "shots")
    video(drive.parent / "drive.avi")
    line = refused.in_a_line(main, *words, code=2)
    assert line.startswith("detect_bag: ")
    assert [text for text in told if text not in line] == []


def test_a_package_that_is_missing_is_named_with_the_command_that_installs_it(
    drive: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    monkeypatch.delitem(sys.modules, "yolov5_lifecycle.offline.detect_recording", raising=False)
    told = refused(main, drive, "--output", "found", *SET_MODEL)
    assert f"{sys.executable} -m pip install rosbags" in told


# Python would keep truncated bytecode of this package: https://github.com/python/cpython/issues/126606.
LIMITED = (
    "import resource, sys; sys.dont_write_bytecode = True; "
    "resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), resource.RLIM_INFINITY)); "
    "from yolov5_lifecycle.offline.detect_bag import main; sys.exit(main(sys.argv[2:]))"
)


def limited(max_bytes: int, *words: object) -> subprocess.CompletedProcess[str]:
    """The command in a process that cannot write files of more than `max_bytes`, as if the disk were full.

    A write that exceeds the limit fails, with EFBIG in place of ENOSPC.
    """
    command = [sys.executable, "-c", LIMITED, str(max_bytes), *map(str, words), *SET_MODEL]
    # `make coverage` would write its data in each process, and report that it cannot.
    unmeasured = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=unmeasured)


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "max_bytes", "words", "told"),
    [
        pytest.param(
            a_good_one, 100_000, ["--images", "--output", "found"], "File too large", id="recording, MCAP"
        ),
        # Small enough for the buffer of a C program, which then fails only when it closes the file.
        pytest.param(
            lambda folder: grey_folder(folder) / "8.png",
            20,
            ["--annotated", "drawn.jpg"],
            "File too large",
            id="JPEG",
        ),
        pytest.param(
            lambda folder: video(folder / "drive.avi"),
            6_000,
            ["--annotated", "drawn.mp4", "--output", "found.jsonl"],
            "is the disk full?",
            id="video",
        ),
    ],
)
def test_an_output_that_cannot_be_written_leaves_nothing(
    make: Callable[[Path], Path],
    max_bytes: int,
    words: list[str],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    source = make(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    ended = limited(max_bytes, source, *words)
    assert ended.returncode == 1
    assert told in ended.stderr
    assert "Traceback" not in ended.stderr
    assert sorted(tmp_path.rglob("*")) == before
