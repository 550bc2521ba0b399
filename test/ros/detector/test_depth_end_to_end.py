"""Images with depth, sent to the installed detector with a tracker, over the real middleware."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image
from support.depth_messages import DEPTH_FRAME, camera_info_message, depth_message
from support.depth_scene import CAMERA
from support.detector_process import (
    NODE,
    PARAMETERS,
    DetectorProcess,
    as_arguments,
    detector_process,
    scene_image,
    scene_truth,
)
from support.sighting import Sighting
from vision_msgs.msg import Detection2DArray, Detection3D, Detection3DArray

from yolov5_lifecycle.ros.messages import stamp_ns
from yolov5_lifecycle.tracking.assignment import iou_matrix

INDEX = 7
"""The image of the scene that is shown, again and again."""
WALL_M = 6.0
PERIOD_S = 0.3
TRUTH = scene_truth(INDEX)
DISTANCES_M = 1.5 + 0.5 * np.arange(len(TRUTH.scores))
"""Depth of each object."""


def scene_depth() -> NDArray[np.float32]:
    """Depth (H, W) in metres of boards in the boxes of the objects, before a wall."""
    depth_m = np.full(CAMERA.size_hw, WALL_M, np.float32)
    rows = list(zip(np.rint(TRUTH.boxes_xyxy).astype(int), DISTANCES_M, strict=True))
    for (left, top, right, bottom), distance_m in reversed(rows):  # the nearest last
        depth_m[top:bottom, left:right] = distance_m
    return depth_m


class DepthViewer:
    """Sends images with their depth to a detector, and receives its detections in space."""

    def __init__(self, detector: DetectorProcess) -> None:
        self._detector = detector
        self.received: list[Detection3DArray] = []
        observer = detector.observer
        best_effort = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._depth = observer.create_publisher(Image, f"{NODE}/depth/image_raw", best_effort)
        self._info = observer.create_publisher(CameraInfo, f"{NODE}/depth/camera_info", best_effort)
        observer.create_subscription(Detection3DArray, f"{NODE}/detections_3d", self.received.append, 10)

    def send(self) -> None:
        """An image of now, with depth and camera_info of the same stamp."""
        shown = scene_image(INDEX)
        stamp_s = stamp_ns(shown.header) / 1e9
        depth, info = depth_message(scene_depth(), stamp_s), camera_info_message(stamp_s)
        self._info.publish(info)
        self._depth.publish(depth)
        self._detector.publish(shown)

    def pairs(self) -> list[tuple[Detection2DArray, Detection3DArray]]:
        """What was received in space, each with the detections in the same image."""
        plain = {stamp_ns(message.header): message for message in self._detector.detections}
        stamps = [(stamp_ns(message.header), message) for message in self.received]
        return [(plain[stamp], message) for stamp, message in stamps if stamp in plain]

    def send_until_all_have_ids(self) -> None:
        sent_s = float("-inf")

        def is_done() -> bool:
            nonlocal sent_s
            if time.monotonic() - sent_s > PERIOD_S:
                self.send()
                sent_s = time.monotonic()
            return any(message.detections and all(ids_of(message)) for message, _ in self.pairs())

        self._detector.observer.wait_for(is_done, "detections in space with ids")


def ids_of(message: Detection2DArray | Detection3DArray) -> list[str]:
    return [detection.id for detection in message.detections]


def distance_from_truth(box_xyxy: NDArray[np.float64], placed: Detection3D) -> float:
    """Of the place, from that of the true object in the box; in parts of its distance from the camera."""
    number = int(iou_matrix(box_xyxy[None], TRUTH.boxes_xyxy)[0].argmax())
    left, top, right, bottom = TRUTH.boxes_xyxy[number]
    x = ((left + right - 1) / 2 - CAMERA.cx) / CAMERA.fx
    y = ((top + bottom - 1) / 2 - CAMERA.cy) / CAMERA.fy
    expected = np.array((x, y, 1.0)) * DISTANCES_M[number]
    position = placed.bbox.center.position
    found = np.array((position.x, position.y, position.z))
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.fixture(scope="module")
def tracking() -> Iterator[DetectorProcess]:
    """A detector in a process of its own, started with depth and a tracker."""
    chosen = {"depth": True, "tracker": "bytetrack", "track_timeout": 60.0, "autostart": True}
    with detector_process(*as_arguments(PARAMETERS | chosen)) as detector:
        yield detector


@pytest.mark.end_to_end
def test_detections_are_published_in_space_as_they_are_in_the_image(tracking: DetectorProcess) -> None:
    viewer = DepthViewer(tracking)
    viewer.send_until_all_have_ids()
    for plain, placed in viewer.pairs():
        assert placed.header.stamp == plain.header.stamp
        assert (plain.header.frame_id, placed.header.frame_id) == ("lens", DEPTH_FRAME)
        assert ids_of(placed) == ids_of(plain)
        for detection, in_space in zip(plain.detections, placed.detections, strict=True):
            assert in_space.header == placed.header
            assert [result.hypothesis for result in in_space.results] == [
                result.hypothesis for result in detection.results
            ]
    plain, placed = viewer.pairs()[-1]
    boxes = Sighting.of(plain).boxes_xyxy
    assert len(boxes) >= len(TRUTH.scores) - 1
    errors = [distance_from_truth(*pair) for pair in zip(boxes, placed.detections, strict=True)]
    assert max(errors) < 0.05
    status = tracking.status()
    assert (status["tracker"], status["depth publishers"]) == ("bytetrack", "1")
    assert int(status["detections placed"]) >= len(boxes)
    assert int(status["confirmed tracks"]) >= len(boxes)
