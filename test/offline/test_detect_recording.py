"""Recordings through the detector: what the node would have published, without ROS."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader, StoragePlugin
from sensor_msgs.msg import CompressedImage, Image
from support.detected_offline import MODEL, SET_MODEL, prepare_once, published, run
from support.official_types import VISION_MSGS_HASHES
from support.recorded_scene import (
    COUNT,
    IMAGE,
    SIZE_HW,
    jpeg,
    raw,
    record,
    recorded_ns,
    shown,
    stamp_s,
)
from support.segmented_offline import COUNT as OBJECTS
from support.segmented_offline import SET_MODEL as SET_SEGMENTING
from support.segmented_offline import segment, segmented
from vision_msgs.msg import Detection2DArray, LabelInfo

from yolov5_lifecycle.detection.class_filter import selection_of
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import OfflineDetector, prepared_for
from yolov5_lifecycle.offline.export.exporting import Export
from yolov5_lifecycle.offline.recording import TYPES
from yolov5_lifecycle.offline.terminal import report
from yolov5_lifecycle.ros.messages import image_of_message
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.sources.scene import CLASS_NAMES
from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.tracking.byte_tracker import ByteTracker, TrackedDetection

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
DETECTIONS, MASKS, DRAWN = "/yolov5/detections", "/yolov5/masks", "/yolov5/image"
ROS_TYPES = {DETECTIONS: Detection2DArray, "/yolov5/label_info": LabelInfo, DRAWN: Image, MASKS: Image}
SETTINGS = Settings.model_validate(MODEL)


def as_ros(path: Path) -> list[tuple[str, int, Any]]:
    """Topic, time and message of everything in a recording, deserialised by ROS itself."""
    with Reader(path) as reader:
        return [
            (connection.topic, time_ns, deserialize_message(bytes(data), ROS_TYPES[connection.topic]))
            for connection, time_ns, data in reader.messages()
        ]


def of_topic(path: Path, topic: str) -> list[Any]:
    return [message for one, _, message in as_ros(path) if one == topic]


def scene(number: int) -> ColourImage:
    return ColourImage(shown(number)[0], "rgb")


def labels_of(message: Image) -> NDArray[np.uint16]:
    assert (message.encoding, message.is_bigendian, message.step) == ("16UC1", 0, 2 * message.width)
    return np.frombuffer(message.data, "<u2").reshape(message.height, message.width)


@pytest.mark.parametrize(
    ("make", "ros_type", "storage"),
    [
        pytest.param(raw, Image, MCAP, id="raw in MCAP"),
        pytest.param(jpeg, CompressedImage, SQLITE, id="JPEG in SQLite"),
    ],
)
def test_a_recording_gets_what_the_node_would_have_published(
    make: Callable[[int], object],
    ros_type: type,
    storage: StoragePlugin,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source = record(tmp_path / "drive", [make(number) for number in range(COUNT)], storage=storage)
    output = tmp_path / "found"
    assert run([str(source), "--output", str(output), "--images", *SET_MODEL]) == 0, capsys.readouterr().err
    assert sorted(file.name for file in output.iterdir()) == ["found.mcap", "metadata.yaml"]
    written = as_ros(output)
    assert [(topic, time_ns) for topic, time_ns, _ in written] == [
        ("/yolov5/label_info", recorded_ns(0)),
        *(
            (topic, recorded_ns(number))
            for number in range(COUNT)
            for topic in ("/yolov5/detections", "/yolov5/image")
        ),
    ]
    with Reader(source) as reader:
        images = [deserialize_message(bytes(data), ros_type) for _, _, data in reader.messages()]
    expected = [message for image in images for message in published(image)]
    assert [message for _, _, message in written[1:]] == expected
    assert [message.header.stamp.sec for message in expected[::2]] == [stamp_s(n) for n in range(COUNT)]
    labels = written[0][2]
    assert {entry.class_id: entry.class_name for entry in labels.class_map} == dict(enumerate(CLASS_NAMES))
    assert (labels.header.stamp, labels.threshold) == (images[0].header.stamp, 0.25)


def test_one_file_of_a_recording_is_enough_and_the_node_has_the_name_that_is_given(
    drive: Path, tmp_path: Path
) -> None:
    file, output = drive / "drive.mcap", tmp_path / "found"
    assert run([str(file), "--output", str(output), "--node", "/robot/front", *SET_MODEL]) == 0
    with Reader(output) as reader:
        (labels,) = reader.topics["/robot/front/label_info"].connections
        assert {name: topic.msgcount for name, topic in reader.topics.items()} == {
            "/robot/front/detections": COUNT,
            "/robot/front/label_info": 1,
        }
    (qos,) = labels.ext.offered_qos_profiles  # type: ignore[union-attr]
    assert qos.durability is QosDurability.TRANSIENT_LOCAL


@pytest.mark.parametrize("name", ["Detection2DArray", "LabelInfo"])
def test_a_type_has_the_hash_that_ros_gives_it(name: str) -> None:
    assert TYPES.hash_rihs01(f"vision_msgs/msg/{name}") == VISION_MSGS_HASHES[name]


def test_unreadable_images_are_reported_counted_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut_off = bytes(TYPES.serialize_cdr(raw(1), IMAGE))[:60]
    source = record(tmp_path / "drive", [raw(0), cut_off, raw(2, encoding="32FC1")], storage=SQLITE)
    assert run([str(source), "--output", str(tmp_path / "found"), *SET_MODEL]) == 0
    told = capsys.readouterr().err
    assert "detect_bag: 1700000000.540000007: rejected: " in told
    assert "detect_bag: 1700000000.580000007: rejected: Encoding '32FC1' is not supported" in told
    assert "images    3: 1 detected, 2 rejected, 0 failed\n" in told
    assert len(as_ros(tmp_path / "found")) == 2


def test_a_recording_has_a_label_image_for_each_array_of_detections(drive: Path, tmp_path: Path) -> None:
    whole, smaller = tmp_path / "whole", tmp_path / "smaller"
    assert segment([str(drive), "--output", str(whole), "--images", *SET_SEGMENTING]) == 0
    written = as_ros(whole)[1:]
    assert [(topic, time_ns) for topic, time_ns, _ in written] == [
        (topic, recorded_ns(number)) for number in range(COUNT) for topic in (DETECTIONS, MASKS, DRAWN)
    ]
    messages = [message for *_, message in written]
    for number, (array, masks, drawn) in enumerate(zip(*(messages[n::3] for n in range(3)), strict=True)):
        expected = segmented(scene(number))
        assert masks.header == array.header
        np.testing.assert_array_equal(labels_of(masks), expected.label_image())
        assert labels_of(masks).max() == len(array.detections) == OBJECTS
        shows = annotate(scene(number), expected, ("cat", "dog", "cow"))
        np.testing.assert_array_equal(image_of_message(drawn).pixels, shows)
    words = [str(drive), "--output", str(smaller), "--images", "--no-masks", *SET_SEGMENTING]
    assert segment(words) == 0
    assert as_ros(smaller)[1:] == [one for one in written if one[0] != MASKS]


@pytest.mark.parametrize(
    ("words", "is_found"),
    [
        pytest.param(["--set", "confidence_threshold=1.0"], False, id="without a detection"),
        pytest.param(["--track", *SET_SEGMENTING], True, id="tracked"),
    ],
)
def test_every_label_image_numbers_the_detections(
    words: list[str], is_found: bool, drive: Path, tmp_path: Path
) -> None:
    assert segment([str(drive), "--output", str(tmp_path / "found"), *words]) == 0
    arrays, found = (of_topic(tmp_path / "found", topic) for topic in (DETECTIONS, MASKS))
    assert any(one.id for array in arrays for one in array.detections) == is_found
    assert len(found) == COUNT
    for number, masks in enumerate(found):
        expected = segmented(scene(number)).label_image() if is_found else np.zeros(SIZE_HW)
        np.testing.assert_array_equal(labels_of(masks), expected)


@pytest.mark.parametrize(
    ("export", "are_needed"),
    [
        pytest.param(Export(Path("x"), ""), True, id="recording"),
        pytest.param(Export(Path("x"), "", masks=False), False, id="recording without masks"),
        pytest.param(Export(Path("x"), "", masks=False, images=True), True, id="drawn recording"),
        pytest.param(Export(None, ".jsonl", masks=False), False, id="lines without masks"),
        pytest.param(Export(None, ".jsonl", masks=False, annotated=Path("y")), True, id="drawn images"),
        pytest.param(Export(Path("x"), ".csv"), False, id="table"),
    ],
)
def test_masks_are_computed_only_if_they_are_written_or_drawn(export: Export, are_needed: bool) -> None:
    assert export.needs_masks == are_needed


def detector() -> Detector:
    return prepare_once(SETTINGS, (USUAL_SOURCE_HW,)).detector


def tracked() -> list[Detections]:
    """What the node finds in the images of the recording, with a tracker."""
    tracking = TrackedDetection(ByteTracker(itertools.count(1)), Settings())
    chosen = selection_of(SETTINGS, detector().class_names)
    return [tracking.detect(detector(), scene(number), chosen, stamp_s(number)) for number in range(COUNT)]


def test_the_messages_of_a_recording_have_ids(drive: Path, tmp_path: Path) -> None:
    output = tmp_path / "found"
    assert run([str(drive), "--output", str(output), "--images", "--track", *SET_MODEL]) == 0
    expected = tracked()
    found = [tuple(one.id for one in array.detections) for array in of_topic(output, DETECTIONS)]
    assert found == [one.track_ids for one in expected]
    assert {*expected[0].track_ids} == {""}
    assert "" not in expected[-1].track_ids
    for number, message in enumerate(of_topic(output, DRAWN)):
        labelled = annotate(scene(number), expected[number], detector().class_names)
        np.testing.assert_array_equal(image_of_message(message).pixels, labelled)


@pytest.mark.parametrize(
    ("stamps_s", "ids", "told"),
    [
        pytest.param([10, 11, 12], ["", "1", "1"], "", id="in order"),
        pytest.param(
            [10, 11, 10.5, 12],
            ["", "1", "", "1"],
            "late images not tracked: 1, jumps back at which tracking began again: 0",
            id="late",
        ),
        pytest.param(
            [10, 11, 5, 6],
            ["", "1", "", "other"],
            "not tracked: 0, jumps back at which tracking began again: 1",
            id="jump",
        ),
    ],
)
def test_images_that_are_late_are_detected_but_not_tracked(
    stamps_s: list[float], ids: list[str], told: str
) -> None:
    quiet: Any = SimpleNamespace(progress=lambda _: None)
    settings = SETTINGS.model_copy(update={"tracker": "bytetrack"})
    offline = OfflineDetector(settings, prepared_for(settings, prepare_once), quiet, with_masks=False)
    image = scene(0)
    stored: list[Any] = [SimpleNamespace(stamp_s=stamp_s, load=lambda: image) for stamp_s in stamps_s]
    found: list[str] = []
    statistics = offline.run(stored, expected=0, write=lambda *args: found.append(args[2].track_ids[0]))
    assert [each if each in ("", "1") else "other" for each in found] == ids
    assert statistics.outcomes[Outcome.DETECTED] == len(stamps_s)
    shown = report(statistics.counts, statistics.objects, expected=0)
    assert (told in shown) if told else ("stamps" not in shown)
