"""What `detect_bag` writes of a model that segments: masks in lines of JSON and in recordings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pycocotools import mask as coco
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import Reader, StoragePlugin
from sensor_msgs.msg import Image
from support.detected_offline import SET_MODEL as SET_DETECTING_MODEL
from support.detected_offline import run as detect
from support.recorded_scene import COUNT, SIZE_HW, images, raw, record, recorded_ns, shown, stamp_s, video
from support.scripted_runtime import ScriptedRuntime
from support.segmented_offline import COUNT as OBJECTS
from support.segmented_offline import SET_MODEL, segment, segmented, whole_masks
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.detection.detector import Detector
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.prepared_model import PreparedModel
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.export.detected_image import DetectedImage
from yolov5_lifecycle.offline.export.json_lines import detection_line
from yolov5_lifecycle.offline.image_files import VideoFile

DETECTIONS, MASKS, DRAWN = "/yolov5/detections", "/yolov5/masks", "/yolov5/image"
TYPES = {DETECTIONS: Detection2DArray, MASKS: Image, DRAWN: Image}


def scene(number: int) -> ColourImage:
    return ColourImage(shown(number)[0], "rgb")


def lines_of(path: Path) -> list[list[Any]]:
    """The detections of each line of JSON."""
    return [json.loads(line)["detections"] for line in path.read_text().splitlines()]


def bag_of(path: Path) -> Mapping[str, list[tuple[int, Any]]]:
    """Times and messages by topic, deserialised by ROS itself."""
    found: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in TYPES}
    with Reader(path) as reader:
        for connection, time_ns, data in reader.messages():
            if connection.topic in TYPES:
                message = deserialize_message(bytes(data), TYPES[connection.topic])
                found[connection.topic].append((time_ns, message))
    return found


def labels_of(message: Image) -> NDArray[np.uint16]:
    assert (message.encoding, message.is_bigendian, message.step) == ("16UC1", 0, 2 * message.width)
    return np.frombuffer(message.data, "<u2").reshape(message.height, message.width)


def without_masks(detections: list[Any]) -> list[Any]:
    return [{key: value for key, value in one.items() if key != "mask"} for one in detections]


def test_lines_have_the_whole_mask_of_each_object(tmp_path: Path) -> None:
    output = tmp_path / "found.jsonl"
    assert segment([str(images(tmp_path / "shots")), "--output", str(output), *SET_MODEL]) == 0
    for number, detections in enumerate(lines_of(output)):
        assert [list(one) for one in detections] == [["class_name", "score", "box_xyxy", "mask"]] * OBJECTS
        expected = whole_masks(segmented(scene(number)))
        assert expected.sum(axis=0).max() > 1
        for one, mask in zip(detections, expected, strict=True):
            theirs = coco.encode(np.asfortranarray(mask, np.uint8))
            assert one["mask"] == {"size": [*SIZE_HW], "counts": theirs["counts"].decode()}


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3], ids=["MCAP", "SQLite"])
def test_a_recording_has_a_label_image_for_each_array_of_detections(
    storage: StoragePlugin, tmp_path: Path
) -> None:
    source = record(tmp_path / "drive", [raw(number) for number in range(COUNT)], storage=storage)
    assert segment([str(source), "--output", str(tmp_path / "found"), "--images", *SET_MODEL]) == 0
    found = bag_of(tmp_path / "found")
    assert {topic: [time_ns for time_ns, _ in messages] for topic, messages in found.items()} == {
        topic: [recorded_ns(number) for number in range(COUNT)] for topic in TYPES
    }
    rows = zip(*([message for _, message in found[topic]] for topic in TYPES), strict=True)
    for number, (array, masks, drawn) in enumerate(rows):
        expected = segmented(scene(number))
        assert masks.header == array.header
        assert (masks.header.stamp.sec, masks.header.frame_id) == (stamp_s(number), "camera")
        np.testing.assert_array_equal(labels_of(masks), expected.label_image())
        assert labels_of(masks).max() == len(array.detections) == OBJECTS
        shows = annotate(scene(number), expected, ("cat", "dog", "cow"))
        np.testing.assert_array_equal(np.frombuffer(drawn.data, np.uint8).reshape(shows.shape), shows)


def test_a_recording_has_label_images_of_images_without_a_detection(drive: Path, tmp_path: Path) -> None:
    words = ["--set", "confidence_threshold=1.0", "--node", "/front"]
    assert segment([str(drive), "--output", str(tmp_path / "found"), *words]) == 0
    with Reader(tmp_path / "found") as reader:
        (masks,) = reader.topics["/front/masks"].connections
        read = [deserialize_message(bytes(data), Image) for _, _, data in reader.messages([masks])]
    assert len(read) == COUNT
    for message in read:
        np.testing.assert_array_equal(labels_of(message), np.zeros(SIZE_HW))


def test_without_masks_a_recording_is_otherwise_the_same(drive: Path, tmp_path: Path) -> None:
    whole, smaller = tmp_path / "whole", tmp_path / "smaller"
    assert segment([str(drive), "--output", str(whole), "--images", *SET_MODEL]) == 0
    assert segment([str(drive), "--output", str(smaller), "--images", "--no-masks", *SET_MODEL]) == 0
    with Reader(smaller) as reader:
        assert sorted(reader.topics) == [DETECTIONS, DRAWN, "/yolov5/label_info"]
    assert bag_of(smaller) == {**bag_of(whole), MASKS: []}


def test_without_masks_lines_are_otherwise_the_same(tmp_path: Path) -> None:
    source, whole, smaller = images(tmp_path / "shots"), tmp_path / "whole.jsonl", tmp_path / "smaller.jsonl"
    assert segment([str(source), "--output", str(whole), *SET_MODEL]) == 0
    assert segment([str(source), "--output", str(smaller), "--no-masks", *SET_MODEL]) == 0
    assert lines_of(smaller) == [without_masks(detections) for detections in lines_of(whole)]


def test_tracked_objects_have_masks(tmp_path: Path) -> None:
    source, output = video(tmp_path / "drive.avi"), tmp_path / "found.jsonl"
    assert segment([str(source), "--output", str(output), "--track", *SET_MODEL]) == 0
    for detections, frame in zip(lines_of(output), VideoFile.open(source).frames, strict=True):
        expected = segmented(frame.image)
        found = DetectedImage(frame, frame.image, expected)
        line = detection_line(found, ("cat", "dog", "cow"), masks=True)
        assert [one.pop("id") is not None for one in detections] == [True] * OBJECTS
        assert detections == json.loads(line)["detections"]


def test_the_label_images_of_a_tracked_recording_number_its_detections(drive: Path, tmp_path: Path) -> None:
    assert segment([str(drive), "--output", str(tmp_path / "found"), "--track", *SET_MODEL]) == 0
    found = bag_of(tmp_path / "found")
    assert any(one.id for _, array in found[DETECTIONS] for one in array.detections)
    for number, (_, masks) in enumerate(found[MASKS]):
        np.testing.assert_array_equal(labels_of(masks), segmented(scene(number)).label_image())


@pytest.mark.parametrize(
    ("words", "computed"),
    [
        pytest.param(["drive", "--output", "found"], COUNT, id="recording"),
        pytest.param(["drive", "--output", "found", "--no-masks"], 0, id="recording without masks"),
        pytest.param(["drive", "--output", "found", "--no-masks", "--images"], COUNT, id="drawn recording"),
        pytest.param(["shots"], COUNT, id="lines"),
        pytest.param(["shots", "--no-masks"], 0, id="lines without masks"),
        pytest.param(["shots", "--no-masks", "--annotated", "drawn"], COUNT, id="drawn images"),
        pytest.param(["drive.avi", "--track", "--no-masks"], 0, id="tracked without masks"),
    ],
)
def test_masks_are_computed_only_if_they_are_written_or_drawn(
    words: list[str], computed: int, drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    images(tmp_path / "shots")
    video(tmp_path / "drive.avi")
    runtime = ScriptedRuntime(lambda: np.array([[60, 60, 40, 40, 1, 0.9, 3]], np.float32))
    calls: list[None] = []

    def prototypes() -> NDArray[np.float32]:
        calls.append(None)
        return np.ones((1, 60, 80), np.float32)

    runtime.compute_prototypes = prototypes
    detector = Detector(runtime, class_names=("cat",), image_size=320, stride=32, mask_coefficients=1)
    assert main(words, prepare=lambda settings, _: PreparedModel(settings, detector, drive, "0" * 64)) == 0
    assert len(calls) == computed


def test_a_model_that_does_not_segment_writes_the_same_as_without_masks(drive: Path, tmp_path: Path) -> None:
    shots = images(tmp_path / "shots")

    def written(folder: Path, *words: str) -> list[bytes]:
        folder.mkdir()
        lines, bag = folder / "found.jsonl", folder / "found"
        assert detect([str(shots), "--output", str(lines), *SET_DETECTING_MODEL, *words]) == 0
        assert detect([str(drive), "--output", str(bag), *SET_DETECTING_MODEL, *words]) == 0
        return [file.read_bytes() for file in (lines, *sorted(bag.iterdir()))]

    as_ever = tmp_path / "ever"
    assert written(as_ever) == written(tmp_path / "none", "--no-masks")
    found = [one for detections in lines_of(as_ever / "found.jsonl") for one in detections]
    assert {tuple(one) for one in found} == {("class_name", "score", "box_xyxy")}
    with Reader(as_ever / "found") as reader:
        assert sorted(reader.topics) == [DETECTIONS, "/yolov5/label_info"]
