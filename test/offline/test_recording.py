"""Recordings of any layout, at any path: every message is read, in little memory, or the file is refused."""

from __future__ import annotations

import os
import sqlite3
import tracemalloc
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from support.detected_offline import SET_MODEL, run
from support.many_recordings import messages, plan_for, result_of
from support.mcap_bytes import MESSAGE, channel, chunk, mcap, message, statistics
from support.mcap_bytes import record as mcap_record
from support.recorded_scene import COMPRESSED, IMAGE, TOPIC, raw, record, recorded_ns
from support.refusals import Refused

from yolov5_lifecycle import outside_yaml
from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.offline import stored_messages
from yolov5_lifecycle.offline.detect_bag import EXIT_INCOMPLETE, main
from yolov5_lifecycle.offline.recording import TYPES, RecordedMessage, RecordingError, open_recording
from yolov5_lifecycle.offline.recordings import is_recording

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
COUNT = 4
CAMERA = channel(1, TOPIC, IMAGE)
SHOWN = [raw(number, height=4) for number in range(COUNT)]
CONTENTS = [bytes(TYPES.serialize_cdr(one, IMAGE)) for one in SHOWN]
IMAGES = [message(1, recorded_ns(number), data) for number, data in enumerate(CONTENTS)]
ALL = b"".join(IMAGES)
STATISTICS = statistics({1: COUNT})
LIDAR = channel(2, "/lidar", "foxglove.PointCloud", encoding="protobuf")


def images(path: Path) -> list[RecordedMessage]:
    with open_recording(path) as recording:
        return list(recording.messages(recording.image_topic()))


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(mcap([CAMERA, *IMAGES], [CAMERA, STATISTICS]), id="outside of chunks"),
        pytest.param(mcap([chunk(CAMERA + ALL)], [CAMERA, STATISTICS]), id="in a chunk without index"),
        pytest.param(mcap([chunk(CAMERA + ALL, "lz4")], [CAMERA, STATISTICS]), id="packed"),
        pytest.param(
            mcap([CAMERA, IMAGES[0], chunk(IMAGES[1] + IMAGES[2]), IMAGES[3]], [CAMERA, STATISTICS]),
            id="in and outside of chunks",
        ),
        pytest.param(mcap([chunk(CAMERA + ALL)], [CAMERA]), id="without statistics"),
        pytest.param(mcap([chunk(CAMERA + ALL)], [STATISTICS]), id="without channels in the summary"),
        pytest.param(
            mcap([chunk(CAMERA + ALL)], [channel(1, TOPIC, IMAGE, has_schema=False), STATISTICS]),
            id="without schemas in the summary",
        ),
        pytest.param(
            mcap([chunk(CAMERA + ALL)], [CAMERA, statistics({})]), id="without counts in the statistics"
        ),
        pytest.param(mcap([LIDAR + CAMERA, message(2, 1, b"?"), *IMAGES]), id="beside another encoding"),
        pytest.param(mcap([CAMERA, b"\x80" + bytes(8), *IMAGES]), id="beside a record of one's own"),
    ],
)
def test_every_image_of_a_legal_file_is_read(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "drive.mcap").write_bytes(content)
    found = images(tmp_path / "drive.mcap")
    assert [image.data for image in found] == CONTENTS
    assert [image.timestamp_ns for image in found] == [recorded_ns(number) for number in range(COUNT)]


def test_images_of_another_encoding_are_named_and_not_read(tmp_path: Path) -> None:
    (tmp_path / "drive.mcap").write_bytes(mcap([channel(1, TOPIC, IMAGE, encoding="protobuf"), *IMAGES[:1]]))
    with pytest.raises(RecordingError, match=rf"no images .* only: {TOPIC} \({IMAGE}, protobuf\)"):
        images(tmp_path / "drive.mcap")


def test_fewer_images_than_a_recording_claims_are_an_exit_code_and_counted_in_a_row(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "drive.mcap"
    short.write_bytes(mcap([CAMERA, *IMAGES], [CAMERA, statistics({1: COUNT + 3})]))
    words = [str(short), "--output", str(tmp_path / "found.jsonl"), *SET_MODEL]
    assert run(words) == EXIT_INCOMPLETE
    assert "claims 7 images, but has 4" in capsys.readouterr().err
    assert len((tmp_path / "found.jsonl").read_text().splitlines()) == COUNT
    for state in ("done", "skipped"):
        row = result_of(short, plan_for(tmp_path / "found"))
        assert (row.state, row.missing) == (state, 3)
    assert (
        main([str(short), "--output", str(tmp_path / "found"), "--jobs", "1", *SET_MODEL]) == EXIT_INCOMPLETE
    )
    assert "4 of 7 expected" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "told"),
    [
        pytest.param(mcap([CAMERA, *IMAGES], profile="ros1"), "rosbags-convert --src", id="of ROS 1"),
        pytest.param(mcap([CAMERA, *IMAGES])[:-50], "`mcap recover` may repair it", id="without its end"),
        pytest.param(b"#ROSBAG V2.0\n", "does not begin like an MCAP file", id="another format"),
        pytest.param(mcap([chunk(CAMERA + chunk(ALL))]), "a chunk within a chunk", id="a chunk in a chunk"),
        pytest.param(mcap([chunk(CAMERA + ALL, crc=1)]), "its checksum is wrong", id="a damaged chunk"),
        pytest.param(mcap([chunk(CAMERA + ALL, "bz2")]), "'bz2', expected zstd or lz4", id="another packing"),
        pytest.param(
            mcap([chunk(CAMERA + ALL, "lz4", claim=len(CAMERA))]),
            "unpacks to more bytes than it claims",
            id="a chunk with more than it claims",
        ),
        pytest.param(
            mcap([chunk(CAMERA + ALL, claim=2**20)]), "unpacks to fewer bytes", id="a chunk with less"
        ),
        pytest.param(
            mcap([CAMERA, IMAGES[0][:1] + b"\xff" * 7 + IMAGES[0][8:]]),
            "a record of",
            id="a giant record",
        ),
        pytest.param(
            mcap([CAMERA, mcap_record(MESSAGE, b"abc"), ALL]), "shorter than its fields", id="a short record"
        ),
        pytest.param(
            mcap([channel(1, "/" * 5000, IMAGE), *IMAGES]), "a name of 5000 bytes", id="a name without end"
        ),
        pytest.param(
            mcap([chunk(CAMERA + message(1, 0, b"") * 40)]), "more messages than", id="tiny messages"
        ),
        pytest.param(
            mcap([channel(number, "/a", "b") for number in range(20)]), "more than 9 channels", id="channels"
        ),
    ],
)
def test_what_is_no_recording_is_refused_with_the_reason(
    content: bytes, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_messages, "MESSAGES_OF_ANY_FILE", 10)
    monkeypatch.setattr(stored_messages, "BYTES_PER_MESSAGE", 1000)
    monkeypatch.setattr(stored_messages, "MAX_TOPICS", 9)
    (tmp_path / "drive.mcap").write_bytes(content)
    with pytest.raises(RecordingError) as raised:
        images(tmp_path / "drive.mcap")
    assert told in str(raised.value)


def test_a_message_that_is_too_large_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stored_messages, "MAX_MESSAGE_BYTES", len(CONTENTS[0]))
    giant = message(1, 0, bytes(1_000_000))
    (tmp_path / "drive.mcap").write_bytes(mcap([CAMERA, giant, chunk(giant + ALL, "lz4")]))
    found = images(tmp_path / "drive.mcap")
    assert [image.data for image in found] == [None, None, *CONTENTS]
    with pytest.raises(ImageError, match="at most 256 MiB"):
        found[0].load()


@pytest.mark.parametrize(
    ("claim", "told"),
    [
        pytest.param(None, "a chunk of 30", id="honest"),
        pytest.param(1000, "unpacks to more bytes than it claims", id="false"),
    ],
)
def test_a_chunk_that_is_too_large_is_refused_before_it_takes_memory(
    claim: int | None, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stored_messages, "MAX_CHUNK_BYTES", 1_000_000)
    (tmp_path / "drive.mcap").write_bytes(mcap([chunk(message(1, 0, bytes(30_000_000)), "lz4", claim=claim)]))
    tracemalloc.start()
    with pytest.raises(RecordingError, match=told):
        images(tmp_path / "drive.mcap")
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 15_000_000


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n)"


def database(folder: Path, *statements: str) -> Path:
    """A recording in SQLite that was changed by `statements`."""
    path = record(folder / "bag", [raw(0)], storage=SQLITE) / "bag.db3"
    connection = sqlite3.connect(path)
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()
    return path


def endless_view(folder: Path, *further: str) -> Path:
    rows = f"{ENDLESS} SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
    return database(folder, "DROP TABLE messages", f"CREATE VIEW messages AS {rows}", *further)


def view_in_capitals(folder: Path) -> Path:
    """SQLite takes the type of an entry of its schema in any case."""
    rename = "UPDATE sqlite_master SET type = 'VIEW' WHERE type = 'view'"
    return endless_view(folder, "PRAGMA writable_schema=ON", rename)


def computed_column(folder: Path) -> Path:
    column = "data BLOB GENERATED ALWAYS AS (zeroblob(1000000000))"
    messages = f"CREATE TABLE messages(id INTEGER, topic_id INTEGER, timestamp INTEGER, {column})"
    return database(folder, "DROP TABLE messages", messages)


def a_pipe_in_place_of(name: str, folder: Path) -> Path:
    bag = record(folder / "bag", [raw(0)])
    (bag / name).unlink()
    os.mkfifo(bag / name)
    return bag


def metadata_with(text: str, folder: Path) -> Path:
    bag = record(folder / "bag", [raw(0)])
    (bag / "metadata.yaml").write_text(text)
    return bag


@pytest.mark.parametrize(
    ("make", "told"),
    [
        pytest.param(endless_view, "has only tables", id="a view without an end"),
        pytest.param(view_in_capitals, "has only tables", id="a view in capitals"),
        pytest.param(computed_column, "has only tables", id="a computed column"),
        pytest.param(lambda f: database(f, "DROP TABLE topics"), "cannot be read", id="no topics"),
        pytest.param(
            lambda f: database(f, "UPDATE messages SET data = 'text'"),
            "bytes for each message",
            id="no bytes",
        ),
        pytest.param(
            lambda f: database(f, "UPDATE topics SET name = x'ff'"), "there are no images", id="no name"
        ),
        pytest.param(
            partial(a_pipe_in_place_of, "bag.mcap"), "bag.mcap is not a regular file", id="a pipe in a folder"
        ),
        pytest.param(
            partial(a_pipe_in_place_of, "metadata.yaml"),
            "metadata.yaml: expected a regular",
            id="as metadata",
        ),
        pytest.param(
            lambda f: metadata_with(" " * ((16 << 20) + 1), f),
            "metadata.yaml: found more than",
            id="large metadata",
        ),
        pytest.param(partial(metadata_with, "a: &a []\nb: [*a, *a]"), "line 2: an alias", id="aliases"),
        pytest.param(
            partial(metadata_with, "[" + "[]," * 60_000), "more than 50,000 values", id="many lists"
        ),
        pytest.param(
            partial(
                metadata_with,
                f"rosbag2_bagfile_information:\n  relative_file_paths: [{'a,' * 10_001}]",
            ),
            "should have at most 10000 items",
            id="many files",
        ),
        pytest.param(partial(metadata_with, "[" * 100), "nested more than 20 deep", id="deep lists"),
        pytest.param(
            partial(metadata_with, "a: 1"), "rosbag2_bagfile_information: Field required", id="other"
        ),
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
    monkeypatch.setattr(stored_messages, "MAX_MESSAGE_BYTES", 300_000)
    added = (
        "INSERT INTO messages (topic_id, timestamp, data) SELECT topic_id, 0, zeroblob(300001) FROM messages"
    )
    found = images(database(tmp_path, added))
    assert [image.data is None for image in found] == [False, True]


@pytest.mark.parametrize(
    ("mode", "storage"),
    [
        *((CompressionMode.MESSAGE, storage) for storage in (MCAP, SQLITE)),
        *((CompressionMode.FILE, storage) for storage in (MCAP, SQLITE)),
        (CompressionMode.STORAGE, MCAP),
    ],
    ids=str,
)
def test_honest_compression_is_read(tmp_path: Path, mode: CompressionMode, storage: StoragePlugin) -> None:
    bag = record(tmp_path / "bag", SHOWN[:1], storage=storage, compression=mode)
    assert [image.data for image in images(bag)] == [CONTENTS[0]]
    (file,) = (path for path in bag.iterdir() if path.name != "metadata.yaml")
    assert is_recording(file)
    assert [image.timestamp_ns for image in images(file)] == [recorded_ns(0)]


def test_a_bag_of_ros_1_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    (tmp_path / "my drives").mkdir()
    bag = tmp_path / "my drives" / "drive.bag"
    bag.write_bytes(b"#ROSBAG V2.0\n")
    assert is_recording(bag)
    with pytest.raises(RecordingError) as refused:
        images(bag)
    assert f"rosbags-convert --src '{bag}' --dst '{bag.with_suffix('')}'" in str(refused.value)


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
    for _ in range(100):
        damaged = np.frombuffer(data, np.uint8).copy()
        damaged[generator.integers(0, len(data), 8)] = generator.integers(0, 256, 8)
        cut = damaged[: generator.integers(0, len(data))].tobytes()
        with pytest.raises(ImageError):
            RecordedMessage(0, type_name, cut, 0).load()


@pytest.fixture
def sqlite_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A recording in SQLite in the current folder."""
    monkeypatch.chdir(tmp_path)
    return record(Path("drive"), [raw(0)], storage=SQLITE)


def test_a_result_in_mcap_is_written_to_any_path(drive: Path, tmp_path: Path) -> None:
    target = tmp_path / "par?mode=ro" / "run#%41"
    target.parent.mkdir()
    assert run([str(drive), "--output", str(target), *SET_MODEL]) == 0
    assert {*target.iterdir()} == {target / f"{target.name}.mcap", target / "metadata.yaml"}
    assert messages(target)


def test_a_source_is_read_from_any_path(sqlite_drive: Path) -> None:
    file = (sqlite_drive / "drive.db3").rename("drive#1%41?mode=memory.db3")
    assert run([str(file), "--output", "found", *SET_MODEL]) == 0
    assert messages(Path("found"))


def test_a_recording_cannot_name_a_database_outside_of_its_folder(sqlite_drive: Path) -> None:
    drive = sqlite_drive
    Path("secret.db3").write_bytes(b"not for you")
    (drive / "drive.db3").rename(drive / "%2e%2e%2fsecret.db3")
    metadata = drive / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("drive.db3", "'%2e%2e%2fsecret.db3'"))
    with open_recording(drive) as recording:
        assert recording.image_topic().count == 1


def test_a_name_that_metadata_cannot_hold_is_refused_at_once(drive: Path, refused: Refused) -> None:
    assert "choose another --output" in refused(run, drive, "--output", "run\udcff", *SET_MODEL)
