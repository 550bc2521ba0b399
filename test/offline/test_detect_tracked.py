"""Recordings and videos with `--track`: the ids that the node would have given."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import Reader
from sensor_msgs.msg import Image
from support.detected_offline import MODEL, SET_MODEL, prepare_once, run
from support.recorded_scene import COUNT, images, shown, stamp_s, video
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.selection import selection
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import OfflineDetector
from yolov5_lifecycle.offline.terminal import report
from yolov5_lifecycle.ros.messages import image_of_message
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker, TrackerSettings
from yolov5_lifecycle.tracking.tracked_detection import TrackedDetection

SETTINGS = Settings.model_validate(MODEL)
every_spelling = pytest.mark.parametrize(
    "words", [["--track"], ["--set", "tracker=bytetrack"], ["-p", "tracker:=bytetrack"]], ids=" ".join
)


def detector() -> Detector:
    return prepare_once(SETTINGS, (USUAL_SOURCE_HW,)).detector


def tracked() -> list[Detections]:
    """What the node finds in the images of the recording, with a tracker."""
    tracking = TrackedDetection(ByteTracker(itertools.count(1)), TrackerSettings())
    chosen = selection(SETTINGS, detector().class_names)
    return [
        tracking.detect(detector(), ColourImage(shown(number)[0], "rgb"), chosen, stamp_s(number))
        for number in range(COUNT)
    ]


@pytest.mark.long
@every_spelling
def test_the_messages_of_a_recording_have_ids(words: list[str], drive: Path, tmp_path: Path) -> None:
    output = tmp_path / "found"
    assert run([str(drive), "--output", str(output), "--images", *SET_MODEL, *words]) == 0
    with Reader(output) as reader:
        data = [(connection.topic, bytes(data)) for connection, _, data in reader.messages()]
    arrays = [deserialize_message(each, Detection2DArray) for topic, each in data if "detections" in topic]
    drawn = [deserialize_message(each, Image) for topic, each in data if topic == "/yolov5/image"]
    expected = tracked()
    assert [tuple(one.id for one in array.detections) for array in arrays] == [e.track_ids for e in expected]
    assert {*expected[0].track_ids} == {""}
    assert "" not in expected[-1].track_ids
    for number, message in enumerate(drawn):
        image = ColourImage(shown(number)[0], "rgb")
        labelled = annotate(image, expected[number], detector().class_names)
        np.testing.assert_array_equal(image_of_message(message).pixels, labelled)


@every_spelling
def test_the_lines_of_a_video_have_ids(words: list[str], tmp_path: Path) -> None:
    source, output, drawn = video(tmp_path / "drive.avi"), tmp_path / "found.jsonl", tmp_path / "drawn.avi"
    command = [str(source), "--output", str(output), "--annotated", str(drawn), *SET_MODEL]
    assert run([*command, *words]) == 0
    lines = [json.loads(line)["detections"] for line in output.read_text().splitlines()]
    assert {one["id"] for one in lines[0]} == {""}
    last = [one["id"] for one in lines[-1]]
    assert "" not in last
    assert len({*last}) == len(last) > 0


@pytest.mark.parametrize(
    ("stamps_s", "ids", "told"),
    [
        pytest.param([10, 11, 12], ["", "1", "1"], "", id="in order"),
        pytest.param(
            [10, 11, 10.5, 12],
            ["", "1", "", "1"],
            "late images not tracked: 1, jumps back at which tracking began anew: 0",
            id="late",
        ),
        pytest.param(
            [10, 11, 5, 6],
            ["", "1", "", "other"],
            "not tracked: 0, jumps back at which tracking began anew: 1",
            id="jump",
        ),
    ],
)
def test_images_that_are_late_are_detected_but_not_tracked(
    stamps_s: list[float], ids: list[str], told: str
) -> None:
    quiet: Any = SimpleNamespace(progress=lambda _: None)
    settings = SETTINGS.model_copy(update={"tracker": "bytetrack"})
    offline = OfflineDetector(settings, quiet, with_masks=False, prepare=prepare_once)
    image = ColourImage(shown(0)[0], "rgb")
    stored: list[Any] = [SimpleNamespace(stamp_s=stamp_s, load=lambda: image) for stamp_s in stamps_s]
    found: list[str] = []
    statistics = offline.run(stored, expected=0, write=lambda *args: found.append(args[2].track_ids[0]))
    assert [each if each in ("", "1") else "other" for each in found] == ids
    assert statistics.balance[Outcome.DETECTED] == len(stamps_s)
    assert (told in report(statistics)) if told else ("stamps" not in report(statistics))


def test_without_a_tracker_lines_have_no_ids(tmp_path: Path) -> None:
    source, output = video(tmp_path / "drive.avi"), tmp_path / "found.jsonl"
    assert run([str(source), "--output", str(output), *SET_MODEL]) == 0
    assert '"id"' not in output.read_text()


def test_an_annotated_video_shows_the_ids(tmp_path: Path) -> None:
    source = video(tmp_path / "drive.avi")
    frames = []
    for name, words in (("plain", []), ("tracked", ["--track"])):
        drawn, lines = tmp_path / f"{name}.avi", tmp_path / f"{name}.jsonl"
        command = [str(source), "--output", str(lines), "--annotated", str(drawn), *SET_MODEL]
        assert run([*command, *words]) == 0
        capture = cv2.VideoCapture(str(drawn))
        frames.append([capture.read()[1] for _ in range(COUNT)])
        capture.release()
    plain, with_ids = frames
    np.testing.assert_array_equal(with_ids[0], plain[0])
    assert (with_ids[1] != plain[1]).any()


@every_spelling
@pytest.mark.parametrize("source", ["shots", "shots/0.png"])
def test_image_files_are_not_tracked(
    source: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images(tmp_path / "shots")
    with pytest.raises(SystemExit, match="2"):
        run([str(tmp_path / source), *SET_MODEL, *words])
    assert "has still images; tracking needs a recording or a video" in capsys.readouterr().err


def test_a_parameter_file_with_a_tracker_serves_image_files_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("/**:\n  ros__parameters:\n    tracker: bytetrack\n")
    assert run([str(images(tmp_path / "shots")), "--params-file", str(file), *SET_MODEL]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == COUNT
    assert not any("id" in one for line in lines for one in line["detections"])
