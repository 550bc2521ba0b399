"""Errors of `detect_bag`: each has a reason, and nothing half-written is left behind."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin
from support.detected_offline import SET_MODEL, run
from support.recorded_scene import (
    COUNT,
    raw,
    record,
    text,
)
from support.scripted_runtime import ScriptedRuntime

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.prepared_model import Prepare, PreparedModel
from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError
from yolov5_lifecycle.sources.scene import CLASS_NAMES

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3


def prepare_raising(error: BaseException) -> Prepare:
    def run() -> NDArray[np.float32]:
        raise error

    detector = Detector(ScriptedRuntime(run), class_names=CLASS_NAMES, image_size=320, stride=32)
    return lambda settings, _: PreparedModel(settings, detector, Path("/raising.pt"), "0" * 64)


@pytest.mark.parametrize(
    ("error", "failures"),
    [
        pytest.param(InferenceError("out of memory"), 2, id="again and again"),
        pytest.param(DeviceLostError("the GPU is gone"), 1, id="device lost"),
    ],
)
def test_detection_ends_after_too_many_failed_inferences(
    error: InferenceError, failures: int, drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(drive), "--output", str(drive.parent / "found"), "--set", "max_consecutive_failures=2"]
    assert main(words, prepare=prepare_raising(error)) == 1
    stopped = f"detect_bag: stopped after {failures} consecutive failed images: {error}\n"
    assert capsys.readouterr().err.endswith(stopped)
    assert list(drive.parent.iterdir()) == [drive]


def test_an_interrupt_leaves_nothing_half_written(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(drive), "--output", str(drive.parent / "found")]
    assert main(words, prepare=prepare_raising(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "detect_bag: interrupted; unfinished output was removed\n"
    assert list(drive.parent.iterdir()) == [drive]


def no_images(folder: Path) -> Path:
    return record(folder / "bag", [text()], storage=MCAP, topics=["/chatter"])


def two_topics(folder: Path) -> Path:
    return record(folder / "bag", [raw(0)], storage=MCAP, topics=["/left", "/right"])


def without_messages(folder: Path) -> Path:
    return record(folder / "bag", [], storage=MCAP)


def all_unreadable(folder: Path) -> Path:
    return record(folder / "bag", [raw(0, encoding="32FC1")], storage=SQLITE)


def without_its_end(folder: Path) -> Path:
    bag = record(folder / "bag", [raw(number) for number in range(COUNT)], storage=MCAP)
    os.truncate(bag / "bag.mcap", 300_000)
    return bag


def with_damaged_pages(folder: Path) -> Path:
    """A database that opens, and breaks when its messages are read."""
    bag = record(folder / "bag", [raw(number) for number in range(COUNT)], storage=SQLITE)
    with (bag / "bag.db3").open("r+b") as file:
        file.seek(60_000)
        file.write(b"\xff" * 500_000)
    return bag


def without_metadata(folder: Path) -> Path:
    bag = record(folder / "bag", [raw(0)], storage=MCAP)
    (bag / "metadata.yaml").unlink()
    return bag


def not_a_recording(folder: Path) -> Path:
    (folder / "bag.mcap").write_bytes(b"these are no messages")
    return folder / "bag.mcap"


def a_good_one(folder: Path) -> Path:
    return record(folder / "bag", [raw(0)], storage=MCAP)


@pytest.mark.long
@pytest.mark.parametrize(
    ("make", "words", "told"),
    [
        pytest.param(no_images, [], "in it, only: /chatter. Record", id="no images"),
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
            all_unreadable, [], "none of 1 images could be used: see the reasons above", id="all unreadable"
        ),
        pytest.param(without_messages, [], "has no messages. Did the camera", id="no messages"),
        pytest.param(without_its_end, [], "`mcap recover` may repair it", id="without its end"),
        pytest.param(with_damaged_pages, [], "the recording cannot be read", id="damaged pages"),
        pytest.param(without_metadata, [], "the recording cannot be read", id="without metadata"),
        pytest.param(not_a_recording, [], "does not begin like an MCAP file", id="not a recording"),
        pytest.param(a_good_one, ["--output", "bag"], "exists and is not replaced", id="output exists"),
        pytest.param(a_good_one, ["--output", "no/x"], "folder not found; create it", id="no folder"),
        pytest.param(a_good_one, ["--set", "classes=[circel]"], "Did you mean 'circle'?", id="class"),
        pytest.param(a_good_one, ["--set", "conf=0.4"], "'confidence_threshold'?", id="setting"),
        pytest.param(a_good_one, ["--set", "iou_threshold=2"], "from 0 to 1", id="value"),
        pytest.param(
            a_good_one, ["--set", "lazy=false"], "a node that receives images", id="setting of the node"
        ),
        pytest.param(a_good_one, ["-p", "iou_threshold:=2"], "from 0 to 1", id="value as for a node"),
        pytest.param(a_good_one, ["-p", "iou_threshold"], "expected NAME=VALUE", id="no value"),
        pytest.param(a_good_one, ["-p", "classes:=[circle, 2]"], "'classes=[circle, 2]': ", id="two types"),
        pytest.param(a_good_one, ["--set", "lazy"], "expected NAME=VALUE", id="no assignment"),
        pytest.param(
            a_good_one,
            ["--set", "classes=[a"],
            "'classes=[a': its value is no YAML that ROS reads: line 1: expected",
            id="no YAML",
        ),
        pytest.param(a_good_one, ["--set", "weights=no.pt"], "there is no such file", id="no weights"),
        pytest.param(a_good_one, ["--params-file", "no.yaml"], "no.yaml", id="no parameter file"),
    ],
)
def test_an_error_says_what_to_do_and_leaves_nothing_behind(
    make: Callable[[Path], Path],
    words: list[str],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    source = make(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert run([str(source), "--output", "found", *SET_MODEL, *words]) == 1
    output, error = capsys.readouterr()
    assert output == ""
    assert error.startswith("detect_bag: ")
    assert told in error
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "told"),
    [
        pytest.param(["drive"], "give --output", id="recording without output"),
        pytest.param(["drive", "--output", "x", "--annotated", "y"], "use --images", id="drawings of it"),
        pytest.param(["shots", "--topic", "/a"], "recordings only", id="topic of images"),
        pytest.param(["shots", "--images"], "recordings only", id="images of images"),
        pytest.param(
            ["drive", "--output", "x", "--node", "a b"], "expected the full name of a node", id="node"
        ),
        pytest.param([], "SOURCE", id="nothing"),
    ],
)
def test_wrong_usage_is_one_line(
    words: list[str],
    told: str,
    drive: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(drive.parent)
    Path("shots").mkdir()
    with pytest.raises(SystemExit) as stopped:
        main(words)
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("detect_bag: ")
    assert told in line


def test_without_rosbags_the_command_says_how_to_install_it(
    drive: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    monkeypatch.delitem(sys.modules, "yolov5_lifecycle.offline.detect_recording", raising=False)
    assert main([str(drive), "--output", str(drive.parent / "found")]) == 1
    assert f"{sys.executable} -m pip install rosbags\n" in capsys.readouterr().err
