"""Results in a frame of the robot: with the transform at their stamp, or dropped with a reason."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2
from support.camera_client import DepthClient, Viewer
from support.depth_messages import header
from support.lone_node import lone_node
from support.point_clouds import points_of
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.detector.transforms import (
    MAX_WAITING,
    FrameOutput,
    Tf2,
    TransformInput,
    Untransformed,
)
from yolov5_lifecycle.ros.messages import moved
from yolov5_lifecycle.ros.observer import PATIENCE_S

CAMERA = Transform(
    translation=Vector3(x=0.2, y=0.1, z=0.8), rotation=Quaternion(x=-0.5, y=0.5, z=-0.5, w=0.5)
)
"""Of a camera that looks forward from above the robot: its z axis is the robot's x axis, its x axis is -y."""
WALL_M = 2.0
OF_CAMERA_XYZ_M, OF_ROBOT_XYZ_M = (-1.161, -0.865, WALL_M), (WALL_M + 0.2, 1.161 + 0.1, 0.865 + 0.8)
"""Where the object is: right, down and forward of the camera; forward, left and above of the robot."""


@dataclass
class ScriptedTransforms:
    """Transforms from the camera to base_link as the test knows them."""

    found: Transform | Untransformed = field(default_factory=lambda: CAMERA)
    asked: list[tuple[str, str, int]] = field(default_factory=list)
    forgotten: int = 0
    is_closed: bool = False
    now_s: float = 100.0
    on_asked: Callable[[], None] = lambda: None

    def look_up(self, target: str, source: str, stamp_ns: int) -> Transform | Untransformed:
        self.asked.append((target, source, stamp_ns // 10**9))
        self.on_asked()
        return self.found

    def forget(self) -> None:
        self.forgotten += 1

    def close(self) -> None:
        self.is_closed = True


@pytest.fixture
def transforms() -> ScriptedTransforms:
    return ScriptedTransforms()


@pytest.fixture
def camera(prepare: Preparations, transforms: ScriptedTransforms) -> Iterator[DepthClient]:
    """Of an active node that publishes in base_link."""
    parameters = ["depth:=true", "target_frame:=base_link", "transform_timeout_s:=10.0"]
    with ServedNode(prepare, parameters=parameters, listen=lambda _: transforms) as served:
        camera = DepthClient(served, wall_m=WALL_M)
        served.bring_to("active")
        camera.wait_for_depth()
        yield camera


def position(camera: DepthClient) -> tuple[float, float, float]:
    (found,) = camera.placed[-1].detections
    point = found.bbox.center.position
    return point.x, point.y, point.z


def test_detections_and_points_are_in_the_frame_that_is_set(
    camera: DepthClient, transforms: ScriptedTransforms
) -> None:
    clouds = Viewer(camera, "points", PointCloud2)
    array = camera.place()
    assert array.header.frame_id == array.detections[0].header.frame_id == "base_link"
    assert position(camera) == pytest.approx(OF_ROBOT_XYZ_M, abs=0.01)
    assert array.detections[0].bbox.center.orientation == CAMERA.rotation
    assert array.detections[0].results[0].pose.pose == array.detections[0].bbox.center
    assert set(transforms.asked) == {("base_link", "_optical", sent) for _, _, sent in transforms.asked}
    assert array.header.stamp.sec in [stamp for _, _, stamp in transforms.asked]
    camera.served.wait_for(lambda: bool(camera.place()) and bool(clouds.received), "a cloud")
    cloud = clouds.received[-1]
    assert cloud.header.frame_id == "base_link"
    points = points_of(cloud)
    assert {round(float(x), 3) for x in points["x"]} == {2.2}
    middle = [(points[axis].min() + points[axis].max()) / 2 for axis in "yz"]
    assert middle == pytest.approx(OF_ROBOT_XYZ_M[1:], abs=0.02)


def test_what_has_no_transform_is_counted_with_the_reason_in_the_diagnostics(
    camera: DepthClient, transforms: ScriptedTransforms
) -> None:
    transforms.found = Untransformed.TOO_OLD

    def count() -> str:
        return camera.served.values()["not transformed: too old"]

    camera.served.wait_for(lambda: bool(send(camera)) and count() != "0", "the count")
    assert camera.placed == []
    told = "too old from _optical to base_link at the stamp of the image: tf knows only later ones"
    camera.served.wait_for(
        lambda: bool(send(camera)) and told in camera.served.status().message, "the reason"
    )


def test_a_transform_after_the_last_image_is_used_and_none_after_deactivation(
    camera: DepthClient, transforms: ScriptedTransforms
) -> None:
    transforms.found = Untransformed.EXTRAPOLATION
    camera.served.wait_for(lambda: bool(send(camera)) and bool(transforms.asked), "a result that waits")
    transforms.found = CAMERA
    camera.served.wait_for(lambda: bool(camera.placed), "its transform, without another image")
    transforms.found, before = Untransformed.EXTRAPOLATION, len(transforms.asked)
    camera.served.wait_for(lambda: bool(send(camera)) and len(transforms.asked) > before, "another one")
    assert camera.served.transition("deactivate")
    assert transforms.is_closed
    placed, waited, transforms.found = len(camera.placed), camera.sent, CAMERA
    assert camera.served.transition("activate")
    camera.place()
    assert camera.placed[placed].header.stamp.sec > waited, "what waited is not sent later"


def send(camera: DepthClient) -> Any:
    """An image with its depth; its detections."""
    camera.send_depth()
    return camera.detect()


def test_the_frame_changes_live_and_transforms_are_received_while_somebody_needs_them(
    camera: DepthClient, transforms: ScriptedTransforms
) -> None:
    camera.place()
    assert camera.served.set(target_frame="") == (True, "")
    assert camera.place().header.frame_id == "_optical"
    assert position(camera) == pytest.approx(OF_CAMERA_XYZ_M, abs=0.01)
    assert transforms.is_closed
    assert camera.served.set(target_frame="map") == (True, "")
    assert camera.place().header.frame_id == "map"
    transforms.is_closed = False
    camera.served.client.destroy_subscription(camera.subscription)
    camera.served.wait_for(lambda: transforms.is_closed, "the end of listening")
    assert "without a leading slash, such as base_link" in camera.served.refusal(target_frame="/map")


def test_without_tf2_a_frame_is_refused_with_what_to_install(
    prepare: Preparations, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    with ServedNode(prepare, parameters=["target_frame:=base_link"]) as served:
        assert served.transition("configure")
        assert not served.transition("activate")
        assert "target_frame: 'base_link' needs tf2" in served.status().message
        assert "sudo apt install ros-jazzy-tf2-ros-py" in served.status().message
        assert served.set(target_frame="") == (True, "")
        assert served.transition("activate")
        assert "'map' needs tf2" in served.refusal(target_frame="map")


# Without a node that detects


@pytest.fixture
def output(ros_domain: int, transforms: ScriptedTransforms) -> Iterator[FrameOutput]:
    """Of a node that is spun by the test alone."""
    with lone_node("yolov5") as node:
        executor = SingleThreadedExecutor(context=node.context)
        executor.add_node(node)
        given = TransformInput(node, lambda _: transforms)
        given.follow("a camera", is_needed=True)
        yield FrameOutput(
            node, given, target_frame="base_link", timeout_s=0.5, clock=lambda: transforms.now_s
        )
        executor.shutdown()


def offer(output: FrameOutput, stamp_s: float, sent: list[float], frame_id: str = "camera") -> None:
    output.offer(header(stamp_s), frame_id, lambda _: sent.append(stamp_s))


def spin(output: FrameOutput, until: Callable[[], bool]) -> None:
    assert output.node.executor is not None
    for _ in range(1000):
        output.node.executor.spin_once(timeout_sec=0.05)
        if until():
            return
    raise AssertionError("it never happens")


@pytest.mark.parametrize(
    ("reason", "waited_s", "is_dropped", "remedy"),
    [
        pytest.param(Untransformed.NO_TRANSFORM, 0.4, False, "", id="waits"),
        pytest.param(Untransformed.NO_TRANSFORM, 0.6, True, "robot_state_publisher", id="no transform"),
        pytest.param(Untransformed.EXTRAPOLATION, 0.6, True, "transform_timeout_s", id="extrapolation"),
        pytest.param(Untransformed.TOO_OLD, 0.0, True, "another clock", id="too old, at once"),
    ],
)
def test_a_result_waits_as_long_as_was_set(
    output: FrameOutput,
    transforms: ScriptedTransforms,
    reason: Untransformed,
    waited_s: float,
    is_dropped: bool,
    remedy: str,
) -> None:
    sent: list[float] = []
    transforms.found = reason
    offer(output, 1.0, sent)
    transforms.now_s += waited_s
    asked = len(transforms.asked)
    spin(output, lambda: len(transforms.asked) > asked + (0 if is_dropped else 3))
    assert (output.counts[reason], output.hint != "", sent) == (is_dropped, is_dropped, [])
    assert remedy in output.hint
    transforms.found = CAMERA
    offer(output, 2.0, sent)
    spin(output, lambda: 2.0 in sent)
    assert sent == ([2.0] if is_dropped else [1.0, 2.0])
    transforms.now_s += 10
    assert output.hint == ""


def test_images_without_a_frame_id_are_told_as_such(
    output: FrameOutput, transforms: ScriptedTransforms
) -> None:
    transforms.found = Untransformed.NO_TRANSFORM
    offer(output, 1.0, [], frame_id="")
    transforms.now_s += 0.6
    spin(output, lambda: output.counts[Untransformed.NO_TRANSFORM] == 1)
    assert "the images and depth images have no frame_id" in output.hint


def fail(_: Transform) -> None:
    raise ZeroDivisionError


def test_more_results_than_may_wait_are_dropped_and_one_that_fails_blocks_no_other(
    output: FrameOutput, transforms: ScriptedTransforms
) -> None:
    sent: list[float] = []
    transforms.found = Untransformed.NO_TRANSFORM
    output.offer(header(0.5), "camera", fail)
    for number in range(MAX_WAITING + 2):
        offer(output, number + 1.0, sent)
    spin(output, lambda: output.counts[Untransformed.TOO_MANY] == 3)
    assert f"later than {MAX_WAITING} results" in output.hint
    transforms.found = CAMERA
    with pytest.raises(ZeroDivisionError):
        spin(output, lambda: False)
    spin(output, lambda: len(sent) == MAX_WAITING - 1)
    assert sent == sorted(sent)
    output.close()
    offer(output, 1000.0, sent)
    assert 1000.0 not in sent
    assert [*output.node.timers] == []


def test_a_result_that_is_offered_while_the_frame_changes_is_dropped(
    output: FrameOutput, transforms: ScriptedTransforms
) -> None:
    sent: list[float] = []
    transforms.found, transforms.on_asked = Untransformed.NO_TRANSFORM, output.close
    assert output.node.executor is not None
    done: list[str] = []
    output.node.executor.create_task(done.append, "before")
    offer(output, 1.0, sent)
    output.node.executor.create_task(done.append, "after")
    transforms.found = CAMERA
    spin(output, lambda: len(done) == 2)  # and what lies between, whichever comes first
    assert sent == []


@pytest.mark.parametrize(
    ("frame_id", "asked"),
    [
        pytest.param("base_link", [], id="the same frame"),
        pytest.param("/camera", [("base_link", "camera", 1)], id="as tf1 wrote it"),
        pytest.param("", [("base_link", "", 1)], id="none"),
    ],
)
def test_frames_have_their_names_in_tf2(
    output: FrameOutput, transforms: ScriptedTransforms, frame_id: str, asked: list[tuple[str, str, int]]
) -> None:
    sent: list[float] = []
    offer(output, 1.0, sent, frame_id)
    assert (transforms.asked, sent) == (asked, [1.0])


@pytest.mark.parametrize(
    ("stamps_s", "forgotten"),
    [
        pytest.param([100, 99.5, 98.7], 0, id="a little disorder"),
        pytest.param([100, 10, 11], 1, id="again"),
        pytest.param([100, -5], 1, id="negative"),
    ],
)
def test_time_that_begins_again_is_forgotten_once(
    output: FrameOutput, transforms: ScriptedTransforms, stamps_s: list[float], forgotten: int
) -> None:
    other = FrameOutput(output.node, output.transforms, target_frame="map", timeout_s=0.5)
    for stamp_s in stamps_s:
        for each in (output, other):
            offer(each, stamp_s, [])
    assert transforms.forgotten == forgotten


# With tf2


@pytest.fixture
def broadcast(ros_domain: int) -> Iterator[tuple[Node, Callable[..., None], Callable[[], None]]]:
    """A node that listens, a broadcaster of a transform, and what spins both."""
    tf2_msgs: Any = pytest.importorskip("tf2_msgs.msg", reason="tf2 comes with ROS from apt")
    pytest.importorskip("tf2_ros", reason="tf2 comes with ROS from apt")
    with lone_node("yolov5") as node:
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        publishers = {
            False: node.create_publisher(tf2_msgs.TFMessage, "/tf", 100),
            True: node.create_publisher(tf2_msgs.TFMessage, "/tf_static", latched),
        }
        executor = SingleThreadedExecutor(context=node.context)
        executor.add_node(node)

        def send(
            parent: str, child: str, transform: Transform, stamp_s: float = 0, static: bool = False
        ) -> None:
            message = TransformStamped(child_frame_id=child, transform=transform)
            message.header.frame_id = parent
            message.header.stamp = Time(seconds=stamp_s).to_msg()
            publishers[static].publish(tf2_msgs.TFMessage(transforms=[message]))

        yield node, send, lambda: executor.spin_once(timeout_sec=0.05)
        executor.shutdown()


def turned(angle: float, x: float) -> Transform:
    half = angle / 2
    return Transform(translation=Vector3(x=x), rotation=Quaternion(z=math.sin(half), w=math.cos(half)))


def test_tf2_finds_moving_static_and_late_transforms_and_says_why_there_is_none(
    broadcast: tuple[Node, Callable[..., None], Callable[[], None]],
) -> None:
    """A camera on a turning pan-tilt, which is on the robot, beside a tree of its own."""
    node, send, spin = broadcast
    send("base_link", "mast", Transform(translation=Vector3(z=1.0)), static=True)  # before anybody listens
    tf2 = Tf2(node)

    def looked_up(source: str, stamp_s: float) -> Transform | Untransformed:
        return tf2.look_up("base_link", source, round(stamp_s * 1e9))

    def wait_for(source: str, stamp_s: float) -> Transform:
        deadline = node.get_clock().now().nanoseconds + PATIENCE_S * 1e9
        while not isinstance(found := looked_up(source, stamp_s), Transform):
            assert node.get_clock().now().nanoseconds < deadline
            spin()
        return found

    wait_for("mast", 1)
    for step in range(5):
        send("mast", "pan", turned(step * 0.2, 0.5), 100 + step)
    wait_for("pan", 104)
    found = wait_for("pan", 101.5)  # between two
    point = np.array([[1.0, 0.0, 0.0]])
    expected = [0.5 + math.cos(0.3), math.sin(0.3), 1.0]
    np.testing.assert_allclose(moved(point, found)[0], expected, atol=1e-6)
    send("world", "elsewhere", CAMERA, static=True)
    for source, stamp_s, reason in (
        ("pan", 105, Untransformed.EXTRAPOLATION),
        ("pan", 99, Untransformed.TOO_OLD),
        ("nowhere", 101, Untransformed.NO_TRANSFORM),
        ("elsewhere", 101, Untransformed.NO_TRANSFORM),
        ("", 101, Untransformed.NO_TRANSFORM),
        ("pan", 0, Untransformed.TOO_OLD),
        ("pan", -5, Untransformed.TOO_OLD),
    ):
        spin()
        assert looked_up(source, stamp_s) is reason
    tf2.forget()
    assert isinstance(looked_up("mast", 1), Transform)
    assert looked_up("pan", 101) is Untransformed.NO_TRANSFORM
    send("mast", "pan", turned(0, 0.5), 1)
    wait_for("pan", 1)
    subscriptions = len([*node.subscriptions])
    tf2.close()
    assert len([*node.subscriptions]) == subscriptions - 2
