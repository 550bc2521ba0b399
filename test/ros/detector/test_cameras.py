"""Several cameras on one model: each with its own topics, settings, balance, depth, masks and troubles."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import Image
from std_msgs.msg import String
from support.camera_client import CameraClient, DepthClient
from support.preparations import Preparations, prediction
from support.served_node import ServedNode, class_ids_of, image
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.ros.observer import Observer

CAMERAS = ("front", "rear")
WALLS_M = (2.0, 3.0)
TRACKING = ("tracker:=bytetrack", "track_timeout:=60.0")


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    """The node with two cameras."""
    with ServedNode(prepare, parameters=["cameras:=[front, rear]"]) as served:
        yield served


@contextmanager
def active_with(prepare: Preparations, *parameters: str) -> Iterator[ServedNode]:
    """The active node with two cameras and these `parameters`."""
    with ServedNode(prepare, parameters=["cameras:=[front, rear]", *parameters]) as served:
        served.bring_to("active")
        yield served


@pytest.fixture
def cameras(served: ServedNode) -> list[CameraClient]:
    return [CameraClient(served, name) for name in CAMERAS]


def found_by(*cameras: CameraClient) -> list[list[str]]:
    """The classes that each of them detects."""
    return [class_ids_of(camera.detect()) for camera in cameras]


def served_topics(served: ServedNode) -> list[str]:
    """Topics with an endpoint of the node."""
    node = served.node
    name, namespace = node.get_name(), node.get_namespace()
    publishers = node.get_publisher_names_and_types_by_node(name, namespace)
    subscribers = node.get_subscriber_names_and_types_by_node(name, namespace)
    return [topic for topic, _ in (*publishers, *subscribers)]


def test_each_camera_has_its_own_topics_status_and_an_exact_balance(
    active: ServedNode, cameras: list[CameraClient]
) -> None:
    front, rear = cameras
    for _ in range(5):
        assert front.detect().header.frame_id == "front_optical"
    active.wait_for(lambda: front.counts()["pending"] == 0, "the last frame")
    statuses = active.statuses()
    assert set(statuses) == {"detection", *CAMERAS}
    assert {status.hardware_id for status in statuses.values()} == {"/yolov5"}
    counts = front.counts()
    assert counts["detected"] >= 5
    assert counts.pop("received") == sum(counts.values())
    assert rear.counts()["received"] == 0
    values = {item.key: item.value for item in statuses["detection"].values}
    assert (values["cameras"], values["state"]) == ("front, rear", "active")
    assert "frames received" not in values
    assert rear.detect().header.frame_id == "rear_optical"
    assert {f"/yolov5/{name}/image" for name in CAMERAS} < set(served_topics(active))
    assert not {"/yolov5/image_raw", "/yolov5/detections"} & set(served_topics(active))


def test_a_camera_that_sends_garbage_is_told_apart_from_the_others(
    active: ServedNode, cameras: list[CameraClient]
) -> None:
    front, rear = cameras

    def are_told_apart() -> bool:
        front.send(image(encoding="nonsense"))
        assert class_ids_of(rear.detect()) == ["cat"]
        _, of_front, of_rear = active.diagnostics[-1].status
        is_told = "'nonsense' is not supported" in of_front.message
        return is_told and of_rear.level == DiagnosticStatus.OK

    active.statuses()
    active.wait_for(are_told_apart, "the rejection")
    of_node, of_front, _ = active.diagnostics[-1].status
    assert of_front.level == DiagnosticStatus.WARN
    assert of_node.message.startswith("front: images are rejected")
    assert "'nonsense' is not supported" in front.values()["last problem"]
    active.wait_for_log("image of camera front rejected: ")
    active.wait_for(lambda: front.counts()["pending"] == 0, "the last frame")
    counts = front.counts()
    assert counts["rejected"] == counts["received"] > 0


def test_failures_of_one_camera_end_the_detection_only_once_the_other_fails_as_well(
    active: ServedNode, prepare: Preparations, cameras: list[CameraClient]
) -> None:
    assert active.set(max_consecutive_failures=3) == (True, "")
    failing = {128}

    def fail_by_height() -> np.ndarray:
        (height, _, _), *_ = prepare.running.calls[-1]
        if height in failing:
            raise RuntimeError("the device is on fire")
        return prediction("cat", 0.9)

    front, rear = cameras
    rear.detect()
    front.size_hw = (24, 128)
    prepare.running.run = fail_by_height
    for failures in range(1, 6):
        active.wait_for(
            lambda wanted=failures: bool(front.send()) and front.counts()["failed"] >= wanted,  # type: ignore[misc]
            "the failure",
        )
        rear.detect()
    assert active.state() == "active"
    assert "on fire" in front.values()["last problem"]
    failing.add(480)
    active.wait_for(lambda: bool(rear.send()) and active.node.state_label == "inactive", "the end")
    assert "failed frames in a row, the last: RuntimeError: the device is on fire" in active.status().message


@pytest.mark.parametrize("is_lazy", [True, False], ids=["while viewed", "once activated"])
def test_a_camera_that_the_middleware_refuses_is_told_and_tried_again_while_the_other_goes_on(
    prepare: Preparations, ros_domain: int, is_lazy: bool
) -> None:
    """Fast DDS has one type for a topic in one process, and the client is in the node's."""
    refused = "cannot subscribe for camera front: "
    with (
        closing(Observer("camera", domain=ros_domain)) as camera,
        ServedNode(prepare, parameters=["cameras:=[front, rear]", f"lazy:={is_lazy}"]) as served,
    ):
        camera.create_publisher(Image, "/yolov5/front/image_raw", 1)
        other = served.client.create_publisher(String, "/yolov5/front/image_raw", 1)
        rear = CameraClient(served, "rear")
        served.bring_to("active")
        assert found_by(rear) == [["cat"]]
        served.client.create_subscription(Detection2DArray, "/yolov5/front/detections", lambda _: None, 1)
        served.wait_for(lambda: served.values("front")["image publishers"] == "1", "the publisher")
        served.wait_for_log(refused)
        for _ in range(5):
            front = served.status("front")
            assert (front.level, front.message[: len(refused)]) == (DiagnosticStatus.WARN, refused)
            assert served.values("front")["last problem"] == front.message
        assert found_by(rear) == [["cat"]]
        assert sum(refused in said for said in served.log) < len(served.diagnostics) / 5
        assert "Traceback" not in str(served.log)
        served.client.destroy_publisher(other)
        assert found_by(CameraClient(served, "front")) == [["cat"]]


def test_other_cameras_need_another_configure(prepare: Preparations) -> None:
    with active_with(prepare, "qos_overrides./yolov5/front/image_raw.subscription.depth:=2") as served:
        reason = served.refusal(cameras=["rear", "left"])
        assert "ros2 lifecycle set /yolov5 deactivate; then ros2 lifecycle set /yolov5 cleanup" in reason
        assert served.set(cameras=[*CAMERAS]) == (True, ""), "as a dump of the node does"
        for cameras in (["rear", "left"], []):
            assert served.transition("deactivate")
            assert served.transition("cleanup")
            assert served.set(cameras=cameras) == (True, "")
            served.bring_to("active")
            client = CameraClient(served, cameras[1]) if cameras else CameraClient(served)
            assert found_by(client) == [["cat"]]
            assert set(served.statuses()) == {"detection", *cameras}
            assert not any("/front/" in topic for topic in served_topics(served))


LONG = "a" * 64
LONG_NAMESPACE = f"/{'n' * 170}"
QOS_OF_FRONT = f"qos_overrides.{LONG_NAMESPACE}/yolov5/front/image_raw.subscription.depth:=2"


def test_a_camera_whose_topics_would_have_too_long_names_fails_configure_until_it_is_renamed(
    prepare: Preparations,
) -> None:
    arguments = ["--ros-args", "-r", f"__ns:={LONG_NAMESPACE}"]
    with ServedNode(prepare, parameters=[f"cameras:=[{LONG}]", QOS_OF_FRONT], arguments=arguments) as served:
        served.wait_for(lambda: bool(served.diagnostics), "diagnostics")
        assert served.node.trigger_configure() is TransitionCallbackReturn.FAILURE
        told = f"ROS refuses the full name of ~/{LONG}/detections"
        served.wait_for(lambda: told in served.diagnostics[-1].status[0].message, "the reason")
        assert served.set(cameras=["front"]) == (True, "")
        assert served.node.trigger_configure() is TransitionCallbackReturn.SUCCESS


def test_each_camera_places_its_tracks_in_its_own_frame_while_its_depth_is_on(prepare: Preparations) -> None:
    with active_with(prepare, "depth:=true", *TRACKING) as served:
        cameras = [
            DepthClient(served, name, wall_m=wall_m) for name, wall_m in zip(CAMERAS, WALLS_M, strict=True)
        ]
        ids = [camera.track() for camera in cameras]
        assert len(set(ids)) == len(CAMERAS)
        for camera, track_id, wall_m in zip(cameras, ids, WALLS_M, strict=True):
            (placed,) = camera.place().detections
            assert placed.header.frame_id == f"{camera.name}_optical"
            assert placed.id == track_id
            assert placed.bbox.center.position.z == pytest.approx(wall_m, rel=0.01)
        front, rear = cameras
        assert served.set(**{"front.depth": False, "rear.tracker": "none"}) == (True, "")
        count = len(front.placed)
        front.send_depth()
        front.detect()
        assert rear.place().detections[0].id == ""
        assert (len(front.placed), front.track()) == (count, ids[0])
        assert served.client.count_subscribers(front.topic("depth/image_raw")) == 0
        told = (
            "~/front/detections_3d has a subscriber, but nothing is published on it: set front.depth to true"
        )
        served.wait_for(
            lambda: bool(front.detect()) and served.statuses()["front"].message == told, "the remark"
        )
        assert served.set(**{"front.depth": True}) == (True, "")
        front.place()


def reliability(camera: CameraClient) -> str:
    """Of the subscription to the images of the camera."""
    infos = camera.served.client.get_subscriptions_info_by_topic(camera.topic("image_raw"))
    return " ".join(info.qos_profile.reliability.name.lower() for info in infos)


def test_each_camera_may_have_a_transport_and_a_reliability_of_its_own(prepare: Preparations) -> None:
    choice = ("front.image_transport:=compressed", "rear.image_reliability:=best_effort")
    with active_with(prepare, *choice) as served:
        front, rear = CameraClient(served, "front", is_compressed=True), CameraClient(served, "rear")
        assert found_by(front, rear) == [["cat"], ["cat"]]
        topics = [camera.values()["image topic"] for camera in (front, rear)]
        assert topics == ["/yolov5/front/image_raw/compressed", "/yolov5/rear/image_raw"]
        assert (reliability(front), reliability(rear)) == ("", "best_effort")
        exchange = {"rear.image_transport": "compressed", "front.image_transport": "raw"}
        assert served.set(**exchange) == (True, "")
        front, rear = CameraClient(served, "front"), CameraClient(served, "rear", is_compressed=True)
        assert found_by(front, rear) == [["cat"], ["cat"]]
        served.wait_for(lambda: reliability(front) == "reliable", "that of the publisher")
        assert rear.values()["image reliability"] == "best_effort"
        assert served.transition("deactivate")
        assert served.set(**{"front.image_transport": "compressed"}) == (True, "")
        expected = "/yolov5/front/image_raw/compressed"
        served.wait_for(lambda: front.values()["image topic"] == expected, "its topic while inactive")
