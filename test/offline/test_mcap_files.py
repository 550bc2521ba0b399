"""MCAP files of any layout: every message is read, in little memory, and what is missing is told."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import pytest
from support.detected_offline import SET_MODEL, run
from support.mcap_bytes import MESSAGE, channel, chunk, mcap, message, record, statistics
from support.recorded_scene import IMAGE, TOPIC, raw, recorded_ns

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.offline import mcap_file
from yolov5_lifecycle.offline.detect_bag import EXIT_INCOMPLETE, main
from yolov5_lifecycle.offline.recording import TYPES, RecordedImage, RecordingError, open_recording

COUNT = 4
CAMERA = channel(1, TOPIC, IMAGE)
CONTENTS = [bytes(TYPES.serialize_cdr(raw(number), IMAGE)) for number in range(COUNT)]
IMAGES = [message(1, recorded_ns(number), data) for number, data in enumerate(CONTENTS)]
ALL = b"".join(IMAGES)
STATISTICS = statistics({1: COUNT})
LIDAR = channel(2, "/lidar", "foxglove.PointCloud", encoding="protobuf")


def images(path: Path) -> list[RecordedImage]:
    with open_recording(path) as recording:
        return list(recording.images(recording.image_topic()))


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
        pytest.param(mcap([CAMERA, *IMAGES]), id="without summary"),
        pytest.param(mcap([chunk(CAMERA + ALL)], [CAMERA]), id="without statistics"),
        pytest.param(mcap([chunk(CAMERA + ALL)], [STATISTICS]), id="without channels in the summary"),
        pytest.param(
            mcap([chunk(CAMERA + ALL)], [channel(1, TOPIC, IMAGE, has_schema=False), STATISTICS]),
            id="without schemas in the summary",
        ),
        pytest.param(
            mcap([chunk(CAMERA + ALL)], [CAMERA, statistics({})]), id="without counts in the statistics"
        ),
        pytest.param(mcap([CAMERA, *IMAGES], profile=""), id="without profile"),
        pytest.param(mcap([LIDAR + CAMERA, message(2, 1, b"?"), *IMAGES]), id="beside another encoding"),
        pytest.param(mcap([CAMERA, b"\x80" + bytes(8), *IMAGES]), id="beside a record of one's own"),
    ],
)
def test_every_image_of_a_legal_file_is_read(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "drive.mcap").write_bytes(content)
    found = images(tmp_path / "drive.mcap")
    assert [image.data for image in found] == CONTENTS
    assert [image.timestamp_ns for image in found] == [recorded_ns(number) for number in range(COUNT)]


def test_channels_that_are_not_of_ros_2_are_named_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "drive.mcap").write_bytes(mcap([LIDAR + CAMERA, *IMAGES]))
    assert run([str(tmp_path / "drive.mcap"), "--output", str(tmp_path / "found"), *SET_MODEL]) == 0
    assert "left out, not of ROS 2: /lidar (protobuf)" in capsys.readouterr().err


@pytest.fixture
def short(tmp_path: Path) -> Path:
    """A recording that claims more images than it has."""
    (tmp_path / "drive.mcap").write_bytes(mcap([CAMERA, *IMAGES], [CAMERA, statistics({1: COUNT + 3})]))
    return tmp_path / "drive.mcap"


def test_fewer_images_than_a_recording_claims_are_an_exit_code(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(short), "--output", str(tmp_path / "found.jsonl"), *SET_MODEL]
    assert run(words) == EXIT_INCOMPLETE
    assert "claims 7 images, but has 4" in capsys.readouterr().err
    assert len((tmp_path / "found.jsonl").read_text().splitlines()) == COUNT


@pytest.mark.long
def test_fewer_images_than_one_of_many_recordings_claims_are_in_its_row(
    short: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(short), "--output", str(tmp_path / "found"), "--jobs", "1", *SET_MODEL]
    for state in ("done", "skipped"):
        assert main(words) == EXIT_INCOMPLETE
        summary = json.loads((tmp_path / "found" / "summary.json").read_text())
        assert (summary["missing"], [row["state"] for row in summary["results"]]) == (3, [state])
        told = capsys.readouterr().err
        assert "3 missing" in told
        assert ("drive: the recording claims 7 images, but has 4" in told) is (state == "done")


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
        pytest.param(mcap([chunk(CAMERA + ALL, claim=2**40)]), "a record ends after", id="a chunk with less"),
        pytest.param(
            mcap([CAMERA, IMAGES[0][:1] + b"\xff" * 7 + IMAGES[0][8:]]),
            "a record of",
            id="a giant record",
        ),
        pytest.param(
            mcap([CAMERA, record(MESSAGE, b"abc"), ALL]), "shorter than its fields", id="a short record"
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
    monkeypatch.setattr(mcap_file, "MESSAGES_OF_ANY_FILE", 10)
    monkeypatch.setattr(mcap_file, "BYTES_PER_MESSAGE", 1000)
    monkeypatch.setattr(mcap_file, "MAX_CHANNELS", 9)
    (tmp_path / "drive.mcap").write_bytes(content)
    with pytest.raises(RecordingError) as raised:
        images(tmp_path / "drive.mcap")
    assert told in str(raised.value)


def test_a_message_that_is_too_large_is_rejected_before_it_takes_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_file, "MAX_MESSAGE_BYTES", len(CONTENTS[0]))
    giant = message(1, 0, bytes(30_000_000))
    (tmp_path / "drive.mcap").write_bytes(mcap([chunk(CAMERA + giant + ALL, "lz4")]))
    del giant
    tracemalloc.start()
    found = images(tmp_path / "drive.mcap")
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert [image.data for image in found[1:]] == CONTENTS
    with pytest.raises(ImageError, match="at most 256 MiB"):
        found[0].load()
    assert peak_bytes < 15_000_000
