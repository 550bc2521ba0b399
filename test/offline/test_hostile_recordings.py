"""Hostile recordings and videos: `detect_bag` refuses them with a reason."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from support.detected_offline import SET_MODEL
from support.recorded_scene import COMPRESSED, IMAGE, TOPIC, jpeg, raw, record, recorded_ns, video

from yolov5_lifecycle import outside_yaml
from yolov5_lifecycle.images.image import MAX_FRAME_ID, ColourImage, ImageError
from yolov5_lifecycle.offline import recording_files, sqlite_file
from yolov5_lifecycle.offline.annotated_files import VideoOutput
from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.image_files import ImageFile, VideoFile
from yolov5_lifecycle.offline.recording import TYPES, RecordedImage, RecordingError, open_recording
from yolov5_lifecycle.offline.recordings import is_recording
from yolov5_lifecycle.sources.frames import SourceError

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"


def images(path: Path) -> list[RecordedImage]:
    with open_recording(path) as recording:
        return list(recording.images(recording.image_topic()))


def database(folder: Path, *statements: str) -> Path:
    """A recording in SQLite that was changed by `statements`."""
    path = record(folder / "bag", [raw(0)], storage=SQLITE) / "bag.db3"
    connection = sqlite3.connect(path)
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()
    return path


def endless_view(folder: Path) -> Path:
    rows = f"{ENDLESS} SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
    return database(folder, "DROP TABLE messages", f"CREATE VIEW messages AS {rows}")


def computed_column(folder: Path) -> Path:
    column = "data BLOB GENERATED ALWAYS AS (zeroblob(1000000000))"
    messages = f"CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, {column})"
    return database(folder, "DROP TABLE messages", messages)


def a_pipe(folder: Path) -> Path:
    os.mkfifo(folder / "bag.mcap")
    return folder / "bag.mcap"


def a_pipe_as_metadata(folder: Path) -> Path:
    bag = record(folder / "bag", [raw(0)], storage=MCAP)
    (bag / "metadata.yaml").unlink()
    os.mkfifo(bag / "metadata.yaml")
    return bag


def a_pipe_that_metadata_names(folder: Path) -> Path:
    bag = record(folder / "bag", [raw(0)], storage=MCAP)
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("bag.mcap", "pipe"))
    os.mkfifo(bag / "pipe")
    return bag


def a_linked_device(folder: Path) -> Path:
    bag = record(folder / "bag", [raw(0)], storage=SQLITE)
    (bag / "bag.db3").unlink()
    (bag / "bag.db3").symlink_to("/dev/zero")
    return bag


def large_metadata(folder: Path) -> Path:
    bag = record(folder / "bag", [raw(0)], storage=MCAP)
    os.truncate(bag / "metadata.yaml", recording_files.MAX_METADATA_BYTES + 1)
    return bag


def metadata_with(text: str, folder: Path) -> Path:
    bag = record(folder / "bag", [raw(0)], storage=MCAP)
    (bag / "metadata.yaml").write_text(text)
    return bag


@pytest.mark.parametrize(
    ("make", "told"),
    [
        pytest.param(endless_view, "has only tables", id="a view without an end"),
        pytest.param(computed_column, "has only tables", id="a computed column"),
        pytest.param(lambda f: database(f, "DROP TABLE topics"), "cannot be read", id="no topics"),
        pytest.param(
            lambda f: database(f, "UPDATE messages SET data = 'text'"),
            "bytes for each message",
            id="no bytes",
        ),
        pytest.param(
            lambda f: database(f, "UPDATE messages SET timestamp = 'now'"), "cannot be read", id="no time"
        ),
        pytest.param(
            lambda f: database(f, "UPDATE topics SET name = x'ff'"), "there are no images", id="no name"
        ),
        pytest.param(a_pipe, "bag.mcap is not a regular file", id="a pipe"),
        pytest.param(a_pipe_that_metadata_names, "pipe is not a regular file", id="a pipe of another name"),
        pytest.param(a_pipe_as_metadata, "metadata.yaml: expected a regular file", id="a pipe as metadata"),
        pytest.param(a_linked_device, "bag.db3 is not a regular file", id="a link to a device"),
        pytest.param(large_metadata, "metadata.yaml: found more than", id="large metadata"),
        pytest.param(partial(metadata_with, "a: &a []\nb: [*a, *a]"), "line 2: an alias", id="aliases"),
        pytest.param(
            partial(metadata_with, "[" + "[]," * 60_000), "more than 50,000 values", id="many lists"
        ),
        pytest.param(partial(metadata_with, "[" * 100), "nested more than 20 deep", id="deep lists"),
        pytest.param(partial(metadata_with, "a: 1"), "no list relative_file_paths", id="other metadata"),
    ],
)
def test_a_hostile_recording_is_refused(
    tmp_path: Path, make: Callable[[Path], Path], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(outside_yaml, "MAX_VALUES", 50_000)
    path = make(tmp_path)
    with pytest.raises(RecordingError) as raised:
        images(path)
    assert told in str(raised.value)
    assert str(raised.value).replace("\n", "").isprintable()


def test_a_giant_value_in_a_database_is_rejected_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sqlite_file, "MAX_MESSAGE_BYTES", 300_000)
    added = (
        "INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, 0, zeroblob(300001) FROM messages"
    )
    found = images(database(tmp_path, added))
    assert [image.data is None for image in found] == [False, True]


@pytest.mark.parametrize("mode", [CompressionMode.MESSAGE, CompressionMode.FILE, CompressionMode.STORAGE])
@pytest.mark.parametrize("storage", [MCAP, SQLITE], ids=["MCAP", "SQLite"])
def test_honest_compression_is_read(tmp_path: Path, mode: CompressionMode, storage: StoragePlugin) -> None:
    if mode is CompressionMode.STORAGE and storage is SQLITE:
        pytest.skip("SQLite has none")
    data = bytes(TYPES.serialize_cdr(raw(0), IMAGE))
    writer = Writer(tmp_path / "bag", version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        writer.write(writer.add_connection(TOPIC, IMAGE, typestore=TYPES), 1, data)
    assert [image.data for image in images(tmp_path / "bag")] == [data]


@pytest.mark.parametrize("storage", [MCAP, SQLITE], ids=["MCAP", "SQLite"])
def test_a_single_packed_file_is_a_recording(storage: StoragePlugin, tmp_path: Path) -> None:
    folder = record(tmp_path / "bag", [raw(0)], storage=storage, compression=CompressionMode.FILE)
    (file,) = folder.glob("*.zstd")
    assert is_recording(file)
    assert [image.timestamp_ns for image in images(file)] == [recorded_ns(0)]


@pytest.mark.parametrize("is_folder", [False, True], ids=["file", "in a folder"])
def test_a_bag_of_ros_1_is_refused_with_the_command_that_converts_it(
    is_folder: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "my drives").mkdir()
    bag = tmp_path / "my drives" / "drive.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n")
    assert main([str(bag.parent if is_folder else bag), "--output", str(tmp_path / "x"), *SET_MODEL]) != 0
    assert f"rosbags-convert --src '{bag}' --dst '{bag.with_suffix('')}'" in capsys.readouterr().err


def test_a_recording_without_metadata_is_refused_with_the_command_that_writes_it(tmp_path: Path) -> None:
    folder = tmp_path / "my drive"
    folder.mkdir()
    (folder / "drive_0.mcap").touch()
    with pytest.raises(RecordingError, match=f"ros2 bag reindex '{folder}'"), open_recording(folder):
        pass


@pytest.mark.parametrize("type_name", [IMAGE, COMPRESSED])
def test_damaged_messages_are_rejected_one_by_one(type_name: str) -> None:
    generator = np.random.default_rng(0)
    data = bytes(TYPES.serialize_cdr(raw(0), IMAGE))[:200]
    for _ in range(300):
        damaged = np.frombuffer(data, np.uint8).copy()
        damaged[generator.integers(0, len(data), 8)] = generator.integers(0, 256, 8)
        cut = damaged[: generator.integers(0, len(data))].tobytes()
        with pytest.raises(ImageError):
            RecordedImage(0, type_name, cut).load()


@pytest.mark.parametrize("make", [raw, jpeg])
def test_a_recorded_image_with_a_long_frame_id_is_rejected(make: Callable[[int], Any]) -> None:
    message = make(0)
    message.header.frame_id = "x" * (MAX_FRAME_ID + 1)
    data = bytes(TYPES.serialize_cdr(message, message.__msgtype__))
    with pytest.raises(ImageError, match="frame_id of at most 256 characters, found 257"):
        RecordedImage(0, message.__msgtype__, data).load()


def test_a_link_to_a_device_is_no_image(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").symlink_to("/dev/zero")
    with pytest.raises(ImageError, match="expected a regular file, found a pipe or device"):
        ImageFile(tmp_path / "1.jpg").load()


def test_a_pipe_is_no_video(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "drive.mp4")
    with pytest.raises(SourceError, match="not a regular file"):
        VideoFile.open(tmp_path / "drive.mp4")


@pytest.mark.parametrize(
    ("make", "told"),
    [
        pytest.param(lambda path: path.write_text("text"), "neither as an image nor", id="text"),
        pytest.param(lambda path: path.touch(), "neither as an image nor", id="empty"),
        pytest.param(
            lambda path: os.truncate(video(path), 400),
            "neither as an image nor|without a readable image",
            id="cut off",
        ),
    ],
)
def test_what_is_no_video_is_refused(tmp_path: Path, make: Callable[[Path], object], told: str) -> None:
    make(tmp_path / "drive.avi")
    with pytest.raises(SourceError, match=told):
        VideoFile.open(tmp_path / "drive.avi")


def test_a_folder_that_is_called_like_a_video_is_a_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drive.mp4").mkdir()
    assert main([str(tmp_path / "drive.mp4")]) == 1
    assert "drive.mp4 has no images" in capsys.readouterr().err


def test_frames_that_change_their_size_are_all_drawn(tmp_path: Path) -> None:
    output = VideoOutput(tmp_path / "drawn.avi", 10.0)
    for size_hw in ((48, 64), (24, 32), (96, 64)):
        output.add(ColourImage(np.zeros((*size_hw, 3), np.uint8), "rgb"))
    output.close()
    capture = cv2.VideoCapture(str(tmp_path / "drawn.avi"))
    assert [capture.read()[0] for _ in range(4)] == [True, True, True, False]
