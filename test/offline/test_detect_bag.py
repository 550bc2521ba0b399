"""The command `detect_bag`: recordings, pictures and videos through the detector, without ROS."""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from rosbags.interfaces import QosDurability
from rosbags.rosbag2 import Reader, StoragePlugin
from sensor_msgs.msg import CompressedImage, Image
from support.colcon_workspace import REPOSITORY
from support.damaged_pictures import claiming_too_much
from support.recorded_scene import (
    COUNT,
    IMAGE,
    SIZE_HW,
    jpeg,
    pictures,
    raw,
    record,
    recorded_ns,
    shown,
    stamp_s,
    text,
    video,
)
from vision_msgs.msg import Detection2DArray, LabelInfo

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW, Detector
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.prepared_model import Prepare, PreparedModel, prepare_model
from yolov5_lifecycle.detection.selection import selection
from yolov5_lifecycle.images.image import Order
from yolov5_lifecycle.offline.detect_bag import main
from yolov5_lifecycle.offline.recorded_types import TYPES
from yolov5_lifecycle.process.standard_streams import EXIT_NOBODY_READS
from yolov5_lifecycle.ros import messages
from yolov5_lifecycle.ros.demo.child_process import entry_point
from yolov5_lifecycle.ros.demo.ground_truth import Sighting
from yolov5_lifecycle.runtimes.runtime import DeviceLostError, InferenceError
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Truth

MODEL = {
    "weights": str(REPOSITORY / "weights" / "shapes.safetensors"),
    "image_size": 320,
    "device": "cpu",
    "runtime": "torch",
}
SET_MODEL = [word for name, value in MODEL.items() for word in ("--set", f"{name}={value}")]
MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
ROS_TYPES = {
    "/yolov5/detections": Detection2DArray,
    "/yolov5/label_info": LabelInfo,
    "/yolov5/image": Image,
}

prepare_once = functools.cache(prepare_model)
run = functools.partial(main, prepare=prepare_once)


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A recording of the scene."""
    return record(tmp_path / "drive", [raw(number) for number in range(COUNT)], storage=MCAP)


def as_ros(path: Path) -> list[tuple[str, int, object]]:
    """Topic, time and message of everything in a recording, deserialised by ROS itself."""
    with Reader(path) as reader:
        return [
            (connection.topic, time_ns, deserialize_message(bytes(data), ROS_TYPES[connection.topic]))
            for connection, time_ns, data in reader.messages()
        ]


def published(message: Image | CompressedImage) -> tuple[Detection2DArray, Image]:
    """What the node publishes for `message`: detections and annotated image."""
    settings = Settings.model_validate(MODEL)
    detector = prepare_once(settings, USUAL_SOURCE_HW).detector
    picture = messages.picture(message)
    detections = detector.detect(picture, selection(settings, detector.class_names))
    drawn = annotate(picture, detections, detector.class_names)
    return (
        messages.detection_array(detections, detector.class_names, message.header),
        messages.image_message(drawn, f"{picture.order}8", message.header),
    )


def true_sighting(truth: Truth, message: Detection2DArray) -> Sighting:
    certain = Detections(truth.boxes_xyxy, np.ones(len(truth.class_ids), np.float32), truth.class_ids)
    return Sighting.now(messages.detection_array(certain, CLASS_NAMES, message.header))


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
    assert written[0][2] == messages.label_info(CLASS_NAMES, 0.25, images[0].header.stamp)


def test_what_is_shown_is_found(drive: Path, tmp_path: Path) -> None:
    assert run([str(drive), "--output", str(tmp_path / "found"), *SET_MODEL]) == 0
    arrays = [message for _, _, message in as_ros(tmp_path / "found")][1:]
    for number, array in enumerate(arrays):
        _, truth = shown(number)
        assert Sighting.now(array).found_of(true_sighting(truth, array)) == len(truth.class_ids)


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
def test_metadata_that_describes_a_topic_otherwise_than_the_file_hides_no_image(
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
    assert "pictures    1: 1 detected" in capsys.readouterr().err


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
def test_unreadable_images_are_told_counted_and_left_out(
    storage: StoragePlugin, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut_off = bytes(TYPES.serialize_cdr(raw(1), IMAGE))[:60]
    source = record(tmp_path / "drive", [raw(0), cut_off, raw(2, encoding="32FC1")], storage=storage)
    assert run([str(source), "--output", str(tmp_path / "found"), *SET_MODEL]) == 0
    told = capsys.readouterr().err
    assert "detect_bag: 1700000000.540000007: rejected: " in told
    assert "detect_bag: 1700000000.580000007: rejected: Encoding '32FC1' is not supported" in told
    assert "pictures    3: 1 detected, 2 rejected, 0 failed\n" in told
    assert len(as_ros(tmp_path / "found")) == 2


class RaisingRuntime:
    """Raises the same with every picture."""

    name, device, precision = "raising", "cpu", "fp32"

    def __init__(self, error: BaseException) -> None:
        self._error = error

    def __call__(
        self, frame: NDArray[np.uint8], order: Order, least_objectness: float = 0.0
    ) -> NDArray[np.float32]:
        raise self._error

    def close(self) -> None:
        pass


def prepare_raising(error: BaseException) -> Prepare:
    detector = Detector(RaisingRuntime(error), class_names=CLASS_NAMES, image_size=320, stride=32)
    return lambda settings, _: PreparedModel(settings, detector, Path("/raising.pt"), "0" * 64)


@pytest.mark.parametrize(
    ("error", "failures"),
    [
        pytest.param(InferenceError("out of memory"), 2, id="again and again"),
        pytest.param(DeviceLostError("the GPU is gone"), 1, id="device lost"),
    ],
)
def test_inference_that_cannot_go_on_is_given_up(
    error: InferenceError, failures: int, drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [str(drive), "--output", str(drive.parent / "found"), "--set", "max_consecutive_failures=2"]
    assert main(words, prepare=prepare_raising(error)) == 1
    given_up = f"detect_bag: stopped after {failures} consecutive failed images: {error}\n"
    assert capsys.readouterr().err.endswith(given_up)
    assert list(drive.parent.iterdir()) == [drive]


def test_an_interrupt_leaves_nothing_half_written(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [str(drive), "--output", str(drive.parent / "found")]
    assert main(words, prepare=prepare_raising(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "detect_bag: interrupted; what was unfinished is removed\n"
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


@pytest.mark.parametrize(
    ("make", "words", "told"),
    [
        pytest.param(no_images, [], "in it, only: /chatter. Record", id="no images"),
        pytest.param(two_topics, [], "--topic which of its image topics:\n  /left  sensor", id="two topics"),
        pytest.param(
            two_topics,
            ["--topic", "/up"],
            "no image topic /up; name one of these:\n  /left",
            id="no such topic",
        ),
        pytest.param(
            all_unreadable, [], "of 1 pictures none could be used: see why above", id="all unreadable"
        ),
        pytest.param(without_messages, [], "is in it without a single message", id="no messages"),
        pytest.param(without_its_end, [], "`mcap recover` may mend it", id="without its end"),
        pytest.param(with_damaged_pages, [], "the recording cannot be read", id="damaged pages"),
        pytest.param(without_metadata, [], "the recording cannot be read", id="without metadata"),
        pytest.param(not_a_recording, [], "magic is invalid", id="not a recording"),
        pytest.param(a_good_one, ["--output", "bag"], "exists and is not replaced", id="output exists"),
        pytest.param(a_good_one, ["--output", "no/x"], "there is no such folder; make it", id="no folder"),
        pytest.param(a_good_one, ["--set", "classes=[circel]"], "Did you mean 'circle'?", id="class"),
        pytest.param(a_good_one, ["--set", "conf=0.4"], "'confidence_threshold'?", id="setting"),
        pytest.param(a_good_one, ["--set", "iou_threshold=2"], "from 0 to 1", id="value"),
        pytest.param(a_good_one, ["--set", "lazy=false"], "images that arrive", id="setting of the node"),
        pytest.param(a_good_one, ["-p", "iou_threshold:=2"], "from 0 to 1", id="value as for a node"),
        pytest.param(a_good_one, ["-p", "iou_threshold"], "expected NAME=VALUE", id="no value"),
        pytest.param(a_good_one, ["-p", "classes:=[circle, 2]"], "'classes=[circle, 2]': ", id="two types"),
        pytest.param(a_good_one, ["--set", "lazy"], "expected NAME=VALUE", id="no assignment"),
        pytest.param(
            a_good_one,
            ["--set", "classes=[a"],
            "'classes=[a': its value is no YAML that ROS reads: while parsing",
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
        pytest.param(["drive", "--output", "x", "--annotated", "y"], "give --images", id="drawings of it"),
        pytest.param(["shots", "--topic", "/a"], "no recording", id="topic of pictures"),
        pytest.param(["shots", "--images"], "no recording", id="images of pictures"),
        pytest.param(["drive", "--output", "x", "--node", "a b"], "no full name of a node", id="node"),
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


def test_pictures_become_lines_and_annotated_pictures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, drawn = pictures(tmp_path / "shots"), tmp_path / "drawn"
    (folder / "1.png").write_bytes(b"no picture")
    (folder / "3.png").write_bytes(claiming_too_much())
    (folder / "notes.txt").write_text("no picture either")
    assert run([str(folder), "--annotated", str(drawn), *SET_MODEL]) == 0
    output, error = capsys.readouterr()
    lines = [json.loads(line) for line in output.splitlines()]
    assert [line["file"] for line in lines] == [str(folder / "0.png"), str(folder / "2.png")]
    assert [(line["height"], line["width"]) for line in lines] == [SIZE_HW] * 2
    found = published(Image(height=240, width=320, encoding="rgb8", step=960, data=shown(0)[0].tobytes()))[0]
    seen = Sighting.now(found)
    assert [one["class_name"] for one in lines[0]["detections"]] == list(seen.class_names)
    assert [one["score"] for one in lines[0]["detections"]] == list(seen.scores)
    boxes_xyxy = [one["box_xyxy"] for one in lines[0]["detections"]]
    np.testing.assert_allclose(boxes_xyxy, seen.boxes_xyxy, atol=1e-4)
    assert f"detect_bag: {folder / '1.png'}: rejected: " in error
    assert f"detect_bag: {folder / '3.png'}: rejected: " in error
    assert "pictures    4: 2 detected, 2 rejected, 0 failed\n" in error
    assert sorted(file.name for file in drawn.iterdir()) == ["0.png", "2.png"]
    assert cv2.imread(str(drawn / "0.png")).shape == (*SIZE_HW, 3)


def test_the_command_ends_quietly_when_nobody_reads_its_lines(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [entry_point("detect_bag"), str(pictures(tmp_path / "shots")), *SET_MODEL]
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert ended.returncode == EXIT_NOBODY_READS
    assert "Broken pipe" not in ended.stderr


def test_a_video_becomes_lines_in_a_file_and_an_annotated_video(tmp_path: Path) -> None:
    source, lines, drawn = video(tmp_path / "drive.avi"), tmp_path / "found.jsonl", tmp_path / "drawn.avi"
    words = [str(source), "--output", str(lines), "--annotated", str(drawn), *SET_MODEL]
    assert run([*words, "--set", "classes=[star]", "-p", "classes:=[circle]"]) == 0
    found = [json.loads(line) for line in lines.read_text().splitlines()]
    assert [line["frame"] for line in found] == list(range(COUNT))
    assert {one["class_name"] for line in found for one in line["detections"]} == {"circle"}
    capture = cv2.VideoCapture(str(drawn))
    assert capture.get(cv2.CAP_PROP_FPS) == pytest.approx(12.5)
    assert [capture.read()[0] for _ in range(COUNT + 1)] == [True] * COUNT + [False]
    capture.release()


def test_a_picture_may_be_called_like_a_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    video(tmp_path / "0.avi").rename("0")
    assert run(["0", "--output", "found.jsonl", *SET_MODEL]) == 0
    assert len(Path("found.jsonl").read_text().splitlines()) == COUNT


@pytest.mark.parametrize(
    ("source", "words", "told"),
    [
        pytest.param("empty", [], "has no pictures", id="empty folder"),
        pytest.param("notes.txt", [], "neither as a picture nor as a video", id="a text"),
        pytest.param("missing", [], "there is no such file or folder", id="missing"),
        pytest.param(
            "missing", ["--topic", "/x"], "there is no such file or folder", id="missing, with a topic"
        ),
        pytest.param("shots/0.png", ["--output", "notes.txt"], "exists and is not", id="lines exist"),
        pytest.param("shots", ["--annotated", "empty"], "exists and is not", id="drawings exist"),
        pytest.param(
            "shots/0.png", ["--annotated", "x.foo"], "x.foo: OpenCV cannot write", id="picture suffix"
        ),
        pytest.param("drive.avi", ["--annotated", "x.foo"], "ends in .mp4 or .avi", id="video suffix"),
    ],
)
def test_what_cannot_be_done_with_files_is_told_and_leaves_nothing_behind(
    source: str,
    words: list[str],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    pictures(tmp_path / "shots")
    video(tmp_path / "drive.avi")
    Path("empty").mkdir()
    Path("notes.txt").write_text("keep me")
    before = sorted(tmp_path.rglob("*"))
    assert run([source, *SET_MODEL, *words]) == 1
    assert told in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before
    assert Path("notes.txt").read_text() == "keep me"
