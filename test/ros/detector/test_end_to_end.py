"""Images to the installed detector over the real middleware, with the embedded model."""

from __future__ import annotations

import signal
from array import array
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Image
from support.detector_process import (
    NODE,
    SEED,
    DetectorProcess,
    as_arguments,
    environment,
    scene_image,
    scene_truth,
)
from support.sighting import Sighting
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.images.encodings import ENCODINGS
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.demo.ground_truth import matched
from yolov5_lifecycle.ros.messages import image_message, image_of_message, stamp_ns
from yolov5_lifecycle.sources.scene import CLASS_NAMES


@pytest.mark.end_to_end
def test_a_camera_and_the_detector_find_the_shapes_where_they_are(detector: DetectorProcess) -> None:
    truths: dict[int, Detection2DArray] = {}

    def take_truth(message: Detection2DArray) -> None:
        truths[stamp_ns(message.header)] = message

    observer, messages = detector.observer, detector.detections
    subscription = observer.create_subscription(Detection2DArray, "/camera/truth", take_truth, 10)
    parameters = {"width": 320, "height": 240, "seed": SEED, "frame_id": "lens"}
    remap = f"image_raw:={NODE}/image_raw"
    command = [entry_point("camera"), "--ros-args", "-r", remap, *as_arguments(parameters)]
    with ChildProcess("camera", command, environment(detector.domain)) as camera:
        observer.wait_for(lambda: bool(truths), "the camera's truth")
        detector.bring_to("active")
        observer.wait_for(lambda: len(messages) >= 60, "60 messages")
        assert {message.header.frame_id for message in messages} == {"lens"}
        pairs = [(truths[stamp], one) for one in messages if (stamp := stamp_ns(one.header)) in truths]
        right = sum(len(matched(truth, found)) for truth, found in pairs)
        assert right > 0.9 * sum(len(truth.detections) for truth, _ in pairs) > 0
        assert detector.transition("deactivate")
        last_ns = stamp_ns(messages[-1].header)
        assert detector.transition("activate")
        observer.wait_for(lambda: stamp_ns(messages[-1].header) > last_ns, "messages once active again")
        assert camera.stop(signal.SIGINT) == 0
    observer.destroy_subscription(subscription)


@pytest.mark.long
@pytest.mark.parametrize("padding", [0, 13])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "rgba8", "bgra8"])
def test_every_encoding_is_understood(active: DetectorProcess, encoding: str, padding: int) -> None:
    shown = scene_image(7, encoding="mono8" if encoding == "mono8" else "rgb8")
    plain = image_message(image_of_message(shown).pixels, "rgb8", shown.header)
    expected = Sighting.of(active.detect(plain))
    assert encoding == "mono8" or expected.found_of(scene_truth(7)) >= len(scene_truth(7).scores) - 1
    found = Sighting.of(active.detect(scene_image(7, encoding=encoding, padding=padding)))
    assert found.class_names == expected.class_names
    assert found.scores == pytest.approx(expected.scores, abs=1e-4)
    assert np.allclose(found.boxes_xyxy, expected.boxes_xyxy, atol=0.05)


def interleaved(*planes: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.dstack(planes).reshape(len(planes[0]), -1)


GREY_ROWS: dict[str, Callable[[NDArray[np.uint8], NDArray[np.uint8]], NDArray[np.uint8]]] = {
    **dict.fromkeys(
        ("8UC1", "bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"), lambda grey, _: grey
    ),
    "8UC3": lambda grey, _: interleaved(grey, grey, grey),
    **dict.fromkeys(("mono16", "16UC1"), lambda grey, _: interleaved(grey, grey)),
    **dict.fromkeys(("uyvy", "yuv422"), lambda grey, neutral: interleaved(neutral, grey)),
    **dict.fromkeys(("yuyv", "yuv422_yuy2"), lambda grey, neutral: interleaved(grey, neutral)),
    **dict.fromkeys(("nv12", "nv21"), lambda grey, neutral: np.vstack((grey, neutral[::2]))),
    "nv24": lambda grey, neutral: np.vstack((grey, neutral, neutral)),
}
"""The rows of a grey image in the encodings that only cameras send, its chroma neutral."""


@pytest.mark.long
@pytest.mark.parametrize("encoding", GREY_ROWS)
def test_every_encoding_of_cameras_is_understood(active: DetectorProcess, encoding: str) -> None:
    image = scene_image(7, encoding="mono8")
    grey = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
    rows = GREY_ROWS[encoding](grey, np.full_like(grey, 128))
    image.encoding, image.step, image.data = encoding, rows.shape[1], array("B", rows.tobytes())
    plain = image_message(image_of_message(image).pixels, "rgb8", scene_image().header)
    found, expected = (Sighting.of(active.detect(each)) for each in (image, plain))
    assert found.class_names == expected.class_names != ()
    assert found.scores == pytest.approx(expected.scores, abs=1e-4)


def test_no_encoding_is_forgotten() -> None:
    assert {*GREY_ROWS, "rgb8", "bgr8", "mono8", "rgba8", "bgra8"} == {*ENCODINGS}


def test_an_image_without_shapes_gives_an_empty_message(active: DetectorProcess) -> None:
    image = scene_image()
    image.data[:] = type(image.data)("B", bytes([114]) * len(image.data))
    assert active.detect(image).detections == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        pytest.param({"encoding": "32FC1"}, "32FC1", id="encoding"),
        pytest.param({"step": 7}, "step", id="step", marks=pytest.mark.long),
        pytest.param({"height": 4000}, "bytes", id="height", marks=pytest.mark.long),
        pytest.param({"width": 0}, "width", id="empty", marks=pytest.mark.long),
    ],
)
def test_an_unreadable_image_is_counted_and_the_next_one_detected(
    active: DetectorProcess, change: dict[str, object], reason: str
) -> None:
    active.look()
    rejected = int(active.status()["frames rejected"])
    image = scene_image()
    for field, value in change.items():
        setattr(image, field, value)
    active.publish(image)
    status = active.wait_until_rejected(rejected + 1, reason)
    assert int(status["frames rejected"]) == rejected + 1
    assert len(active.look().scores) > 0


def test_the_annotated_image_has_the_header_of_its_source_and_boxes_drawn(active: DetectorProcess) -> None:
    drawn: list[Image] = []
    topic = f"{NODE}/image"
    subscription = active.observer.create_subscription(Image, topic, drawn.append, QoSProfile(depth=1))

    def is_discovered() -> bool:
        active.look()
        return bool(drawn)

    active.observer.wait_for(is_discovered, "the node to discover the subscriber")
    source = scene_image()
    found = Sighting.of(active.detect(source))
    active.observer.wait_for(lambda: drawn[-1].header == source.header, "the annotated image")
    active.observer.destroy_subscription(subscription)
    changed = (image_of_message(drawn[-1]).pixels != image_of_message(source).pixels).any(axis=2)
    for x1, y1, _, y2 in np.rint(found.boxes_xyxy).astype(int):
        left_side = changed[y1 + 3 : y2 - 3, max(x1 - 1, 0) : x1 + 2]
        assert left_side.any(axis=1).mean() > 0.9


def test_labels_reach_a_late_subscriber(active: DetectorProcess) -> None:
    assert active.node.set_parameters(confidence_threshold=0.5) == ""
    labels = active.late_label_info()
    assert [(entry.class_id, entry.class_name) for entry in labels.class_map] == list(enumerate(CLASS_NAMES))
    assert labels.threshold == 0.5
