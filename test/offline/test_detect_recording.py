"""Recordings through the detector: what the node would have published, without ROS."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader, StoragePlugin
from sensor_msgs.msg import CompressedImage, Image
from support.detected_offline import SET_MODEL, published, run
from support.recorded_scene import (
    COUNT,
    IMAGE,
    jpeg,
    raw,
    record,
    recorded_ns,
    shown,
    stamp_s,
)
from support.sighting import Sighting
from vision_msgs.msg import Detection2DArray, LabelInfo

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.offline.recording import TYPES
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.detector.session import label_info
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Truth

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
ROS_TYPES = {
    "/yolov5/detections": Detection2DArray,
    "/yolov5/label_info": LabelInfo,
    "/yolov5/image": Image,
}


def as_ros(path: Path) -> list[tuple[str, int, object]]:
    """Topic, time and message of everything in a recording, deserialised by ROS itself."""
    with Reader(path) as reader:
        return [
            (connection.topic, time_ns, deserialize_message(bytes(data), ROS_TYPES[connection.topic]))
            for connection, time_ns, data in reader.messages()
        ]


def true_sighting(truth: Truth, message: Detection2DArray) -> Sighting:
    certain = Detections(truth.boxes_xyxy, np.ones(len(truth.class_ids), np.float32), truth.class_ids)
    return Sighting.of(messages.detection_array(certain, CLASS_NAMES, message.header))


@pytest.mark.parametrize(
    ("make", "ros_type", "storage", "suffix"),
    [
        pytest.param(raw, Image, MCAP, ".mcap", id="raw in MCAP"),
        pytest.param(raw, Image, SQLITE, ".db3", id="raw in SQLite"),
        pytest.param(jpeg, CompressedImage, MCAP, ".mcap", id="JPEG in MCAP"),
        pytest.param(jpeg, CompressedImage, SQLITE, ".db3", id="JPEG in SQLite"),
    ],
)
def test_a_recording_gets_what_the_node_would_have_published(
    make: Callable[[int], object],
    ros_type: type,
    storage: StoragePlugin,
    suffix: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    source = record(tmp_path / "drive", [make(number) for number in range(COUNT)], storage=storage)
    output = tmp_path / "found"
    assert run([str(source), "--output", str(output), "--images", *SET_MODEL]) == 0, capsys.readouterr().err
    assert sorted(file.name for file in output.iterdir()) == sorted(["metadata.yaml", f"found{suffix}"])
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
    assert written[0][2] == label_info(CLASS_NAMES, 0.25, images[0].header.stamp)


def test_what_is_shown_is_found(drive: Path, tmp_path: Path) -> None:
    assert run([str(drive), "--output", str(tmp_path / "found"), *SET_MODEL]) == 0
    arrays = [message for _, _, message in as_ros(tmp_path / "found")][1:]
    for number, array in enumerate(arrays):
        _, truth = shown(number)
        assert Sighting.of(array).found_of(true_sighting(truth, array)) == len(truth.class_ids)


def test_one_file_of_a_recording_is_enough_and_the_node_has_the_name_that_is_given(
    drive: Path, tmp_path: Path
) -> None:
    file, output = drive / "drive.mcap", tmp_path / "found"
    assert run([str(file), "--output", str(output), "--node", "/robot/front", *SET_MODEL]) == 0
    with Reader(output) as reader:
        assert {name: topic.msgcount for name, topic in reader.topics.items()} == {
            "/robot/front/detections": COUNT,
            "/robot/front/label_info": 1,
        }


@pytest.mark.parametrize("storage", [MCAP, SQLITE], ids=["MCAP", "SQLite"])
def test_metadata_that_contradicts_the_file_hides_no_image(
    storage: StoragePlugin, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = record(tmp_path / "drive", [raw(0)], storage=storage)
    metadata = source / "metadata.yaml"
    never = "{sec: 0, nsec: 0}"
    other_qos = (
        "offered_qos_profiles: [{history: keep_last, depth: 7, reliability: reliable, durability: volatile, "
        f"deadline: {never}, lifespan: {never}, liveliness: automatic, liveliness_lease_duration: {never}, "
        "avoid_ros_namespace_conventions: false}]"
    )
    metadata.write_text(metadata.read_text().replace("offered_qos_profiles: []", other_qos))
    assert other_qos in metadata.read_text()
    assert run([str(source), "--output", str(tmp_path / "found"), *SET_MODEL]) == 0
    assert "images    1: 1 detected" in capsys.readouterr().err


def test_labels_are_latched(drive: Path, tmp_path: Path) -> None:
    assert run([str(drive), "--output", str(tmp_path / "found"), *SET_MODEL]) == 0
    with Reader(tmp_path / "found") as reader:
        (labels,) = reader.topics["/yolov5/label_info"].connections
    (qos,) = labels.ext.offered_qos_profiles  # type: ignore[union-attr]
    assert qos.durability is QosDurability.TRANSIENT_LOCAL


@pytest.mark.parametrize("name", ["Detection2DArray", "LabelInfo"])
def test_a_type_has_the_hash_that_ros_gives_it(name: str) -> None:
    generated = Path(sys.prefix, "share", "vision_msgs", "msg", f"{name}.json").read_text()
    hashes = {entry["type_name"]: entry["hash_string"] for entry in json.loads(generated)["type_hashes"]}
    full_name = f"vision_msgs/msg/{name}"
    assert TYPES.hash_rihs01(full_name) == hashes[full_name]


@pytest.mark.parametrize("storage", [MCAP, SQLITE], ids=["MCAP", "SQLite"])
def test_unreadable_images_are_reported_counted_and_left_out(
    storage: StoragePlugin, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut_off = bytes(TYPES.serialize_cdr(raw(1), IMAGE))[:60]
    source = record(tmp_path / "drive", [raw(0), cut_off, raw(2, encoding="32FC1")], storage=storage)
    assert run([str(source), "--output", str(tmp_path / "found"), *SET_MODEL]) == 0
    told = capsys.readouterr().err
    assert "detect_bag: 1700000000.540000007: rejected: " in told
    assert "detect_bag: 1700000000.580000007: rejected: Encoding '32FC1' is not supported" in told
    assert "images    3: 1 detected, 2 rejected, 0 failed\n" in told
    assert len(as_ros(tmp_path / "found")) == 2
