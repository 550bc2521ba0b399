"""The node on the page about tf2 publishes detections in another frame, where tf2 is installed."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from contextlib import closing
from pathlib import Path

import pytest
from geometry_msgs.msg import Point, TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from support.colcon_workspace import REPOSITORY
from support.detector_process import environment
from support.pages import blocks
from vision_msgs.msg import Detection3D, Detection3DArray, ObjectHypothesisWithPose

from yolov5_lifecycle.ros.child_process import ChildProcess
from yolov5_lifecycle.ros.observer import Observer

(PROGRAM,) = blocks(REPOSITORY / "docs" / "tf2.md", "python")


def of_camera() -> Detection3DArray:
    """One object, half a metre to the right of the camera, 1 m below and 4 m before it."""
    array = Detection3DArray()
    array.header.frame_id = "camera"
    array.header.stamp.sec = 100
    result = ObjectHypothesisWithPose()
    detection = Detection3D(results=[result])
    for pose in (detection.bbox.center, result.pose.pose):
        pose.position = Point(x=0.5, y=1.0, z=4.0)
        pose.orientation.w = 1.0
    array.detections = [detection]
    return array


def mounted(observer: Observer) -> None:
    """Publish where the camera is: 0.2 m before and 0.8 m above base_link, looking forward."""
    transform = TransformStamped(child_frame_id="camera")
    transform.header.frame_id = "base_link"
    transform.transform.translation.x, transform.transform.translation.z = 0.2, 0.8
    turn = transform.transform.rotation  # roll and yaw of -90 degrees
    turn.x, turn.y, turn.z, turn.w = -0.5, 0.5, -0.5, 0.5
    message_type = importlib.import_module("tf2_msgs.msg").TFMessage
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    observer.create_publisher(message_type, "/tf_static", latched).publish(
        message_type(transforms=[transform])
    )


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("tf2_ros", "tf2_geometry_msgs")),
    reason="tf2_ros and tf2_geometry_msgs are not installed",
)
def test_the_program_names_a_frame_that_nobody_publishes_and_then_publishes_detections_in_it(
    tmp_path: Path, ros_domain: int
) -> None:
    file = tmp_path / "detections_in_frame.py"
    file.write_text(PROGRAM)
    variables = environment(ros_domain) | {"PYTHONPATH": os.environ.get("PYTHONPATH", "")}
    with (
        ChildProcess("program", [sys.executable, str(file)], variables) as process,
        closing(Observer("client", domain=ros_domain, check=process.check_running)) as observer,
    ):
        found: list[Detection3DArray] = []
        observer.create_subscription(Detection3DArray, "/detections_3d_in_frame", found.append, 1)
        publisher = observer.create_publisher(Detection3DArray, "/yolov5/detections_3d", 1)

        def is_told() -> bool:
            publisher.publish(of_camera())
            return "no transform to base_link: " in process.output

        observer.wait_for(is_told, "the warning")
        mounted(observer)

        def is_found() -> bool:
            publisher.publish(of_camera())
            return bool(found)

        observer.wait_for(is_found, "detections in base_link")
    array = found[0]
    (detection,) = array.detections
    assert (array.header.frame_id, detection.header.frame_id) == ("base_link", "base_link")
    assert array.header.stamp.sec == 100
    for pose in (detection.bbox.center, detection.results[0].pose.pose):
        place = pose.position
        assert (place.x, place.y, place.z) == pytest.approx((4.2, -0.5, -0.2))
