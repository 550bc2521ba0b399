"""Depth of the camera's scene, the executable as a process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from support.camera_process import camera_process
from support.detector_process import as_arguments
from vision_msgs.msg import Detection2DArray, Detection3DArray

from yolov5_lifecycle.ros.messages import image_of_message, stamp_ns
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.sources.scene import Scene
from yolov5_lifecycle.sources.scene_depth import SceneDepth
from yolov5_lifecycle.spatial.depth_image import depth_image_of_message
from yolov5_lifecycle.spatial.intrinsics import intrinsics_of_message

SEED = 4
SIZE_HW = (120, 160)
CAMERA = {"width": SIZE_HW[1], "height": SIZE_HW[0], "seed": SEED, "frame_id": "lens"}
TOPICS = {
    "/front/image_raw": Image,
    "/front/camera_info": CameraInfo,
    "/front/depth/image_raw": Image,
    "/front/depth/camera_info": CameraInfo,
    "/camera/truth": Detection2DArray,
    "/camera/ground_truth_3d": Detection3DArray,
}


@pytest.fixture
def observer(ros_domain: int) -> Iterator[Observer]:
    with closing(Observer("client", domain=ros_domain)) as observer:
        yield observer


class Received:
    """The messages of TOPICS by topic and stamp."""

    def __init__(self, observer: Observer) -> None:
        self.by_topic: dict[str, dict[int, Any]] = {topic: {} for topic in TOPICS}
        for topic, message_type in TOPICS.items():
            observer.create_subscription(message_type, topic, self._taker(topic), 10)

    @property
    def complete(self) -> list[int]:
        """Stamps of which every topic has a message."""
        return sorted(set.intersection(*(set(messages) for messages in self.by_topic.values())))

    def _taker(self, topic: str) -> Any:
        def take(message: Any) -> None:
            self.by_topic[topic][stamp_ns(message.header)] = message

        return take


def ids_of(message: Detection2DArray | Detection3DArray) -> list[str]:
    return [detection.id for detection in message.detections]


@pytest.mark.long
def test_depth_has_stamp_size_and_frame_of_the_image_and_its_truth_the_same_ids(
    observer: Observer, ros_domain: int
) -> None:
    received = Received(observer)
    arguments = ["-r", "image_raw:=/front/image_raw", *as_arguments(CAMERA | {"depth": True})]
    with camera_process(ros_domain, "--ros-args", *arguments):
        observer.wait_for(lambda: len(received.complete) >= 3, "messages on every topic")
    scene = Scene(SEED, SIZE_HW)
    space = SceneDepth(SEED, scene)
    index_of = {scene.frame(index)[0].tobytes(): index for index in range(1000)}
    for stamp in received.complete:
        image, info, depth, depth_info, truth, places = (received.by_topic[topic][stamp] for topic in TOPICS)
        expected = space.frame(index_of[image_of_message(image).pixels.tobytes()])
        assert image.header == depth.header == depth_info.header == truth.header == places.header
        assert (depth.encoding, depth.header.frame_id) == ("16UC1", "lens")
        np.testing.assert_array_equal(depth_image_of_message(depth).values, expected.depth_mm)
        assert info == depth_info
        assert intrinsics_of_message(info).size_hw == SIZE_HW
        assert intrinsics_of_message(info).fx == SIZE_HW[1]
        assert ids_of(places) == ids_of(truth) == [str(number) for number in range(1, 7)]
        boxes = [detection.bbox for detection in places.detections]
        centres = [(box.center.position.x, box.center.position.y, box.center.position.z) for box in boxes]
        np.testing.assert_allclose(centres, expected.centres_xyz_m)
        np.testing.assert_allclose([(b.size.x, b.size.y, b.size.z) for b in boxes], expected.sizes_xyz_m)


@pytest.mark.long
def test_without_depth_there_are_no_topics_of_it_and_no_calibration(
    observer: Observer, ros_domain: int
) -> None:
    infos: list[CameraInfo] = []
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    observer.create_subscription(CameraInfo, "/front/camera_info", infos.append, latched)
    arguments = ["-r", "image_raw:=/front/image_raw", *as_arguments(CAMERA)]
    with camera_process(ros_domain, "--ros-args", *arguments):
        observer.wait_for(lambda: bool(infos), "the camera's info")
        published = {name for name, _ in observer.get_topic_names_and_types()}
    assert not {name for name in published if "depth" in name or "3d" in name}
    assert "/front/image_raw" in published
    assert list(infos[0].k) == [0.0] * 9


@pytest.mark.long
def test_the_depth_topics_have_qos_overrides(observer: Observer, ros_domain: int) -> None:
    override = {"qos_overrides./depth/image_raw.publisher.depth": 3}
    depths: list[Image] = []
    observer.create_subscription(Image, "/depth/image_raw", depths.append, 10)
    with camera_process(ros_domain, "--ros-args", *as_arguments(CAMERA | {"depth": True} | override)):
        observer.wait_for(lambda: bool(depths), "a depth image")
