"""Several cameras on one model: each with its own topics, settings, balance and troubles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import TransitionCallbackReturn
from support.camera_client import CameraClient
from support.preparations import Preparations, prediction
from support.served_node import ServedNode, class_ids_of, image

from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW

CAMERAS = ("front", "rear")


@pytest.fixture
def served(prepare: Preparations) -> Iterator[ServedNode]:
    """The node with two cameras."""
    with ServedNode(prepare, parameters=["cameras:=[front, rear]"]) as served:
        yield served
    assert served.escaped == []


@pytest.fixture
def cameras(served: ServedNode) -> dict[str, CameraClient]:
    return {name: CameraClient(served, name) for name in CAMERAS}


def test_each_camera_has_its_own_topics(served: ServedNode, cameras: dict[str, CameraClient]) -> None:
    served.bring_to("active")
    for name, camera in cameras.items():
        detections = camera.detect()
        assert class_ids_of(detections) == ["cat"]
        assert detections.header.frame_id == f"{name}_optical"
    topics = {name for name, _ in served.node.get_topic_names_and_types()}
    assert {f"/yolov5/{name}/image" for name in CAMERAS} < topics
    assert not {"/yolov5/image_raw", "/yolov5/detections"} & set(served_topics(served))


def served_topics(served: ServedNode) -> list[str]:
    """Topics with an endpoint of the node."""
    node = served.node
    name, namespace = node.get_name(), node.get_namespace()
    publishers = node.get_publisher_names_and_types_by_node(name, namespace)
    subscribers = node.get_subscriber_names_and_types_by_node(name, namespace)
    return [topic for topic, _ in (*publishers, *subscribers)]


def test_a_camera_may_override_a_live_setting(served: ServedNode, cameras: dict[str, CameraClient]) -> None:
    served.bring_to("active")
    assert served.set(**{"front.confidence_threshold": 0.95}) == (True, "")
    assert class_ids_of(cameras["front"].detect()) == []
    assert class_ids_of(cameras["rear"].detect()) == ["cat"]
    assert served.set(confidence_threshold=0.95) == (True, "")
    assert served.set(**{"front.confidence_threshold": 0.5}) == (True, "")
    assert class_ids_of(cameras["front"].detect()) == ["cat"]
    assert class_ids_of(cameras["rear"].detect()) == []


def test_each_camera_has_a_status_and_an_exact_balance(
    served: ServedNode, cameras: dict[str, CameraClient]
) -> None:
    served.bring_to("active")
    front = cameras["front"]
    for _ in range(5):
        front.detect()
    served.wait_for(lambda: front.counts()["pending"] == 0, "the last frame")
    statuses = served.statuses()
    assert set(statuses) == {"detection", *CAMERAS}
    assert {status.hardware_id for status in statuses.values()} == {"/yolov5"}
    counts = front.counts()
    assert counts["detected"] >= 5
    assert counts.pop("received") == sum(counts.values())
    assert cameras["rear"].counts()["received"] == 0
    values = {item.key: item.value for item in statuses["detection"].values}
    assert (values["cameras"], values["state"]) == ("front, rear", "active")
    assert "frames received" not in values


def test_a_camera_that_sends_garbage_is_told_apart_from_the_others(
    served: ServedNode, cameras: dict[str, CameraClient]
) -> None:
    served.bring_to("active")
    front, rear = cameras["front"], cameras["rear"]

    def are_told_apart() -> bool:
        front.send(image(encoding="nonsense"))
        assert class_ids_of(rear.detect()) == ["cat"]
        _, of_front, of_rear = served.diagnostics[-1].status
        is_told = "'nonsense' is not supported" in of_front.message
        return is_told and of_rear.level == DiagnosticStatus.OK

    served.statuses()
    served.wait_for(are_told_apart, "the rejection")
    of_node, of_front, _ = served.diagnostics[-1].status
    assert of_front.level == DiagnosticStatus.WARN
    assert of_node.message.startswith("front: images are rejected")
    assert "'nonsense' is not supported" in front.values()["last problem"]
    served.wait_for_log("image of camera front rejected: ")


def test_failures_of_one_camera_do_not_end_the_detection_of_another(
    served: ServedNode, prepare: Preparations, cameras: dict[str, CameraClient]
) -> None:
    served.bring_to("active")
    assert served.set(max_consecutive_failures=3) == (True, "")
    wide = image(48, 128)

    def fail_if_wide() -> np.ndarray:
        (height, width, _), *_ = prepare.running.calls[-1]
        if width > 2 * height:
            raise RuntimeError("too wide")
        return prediction("cat", 0.9)

    prepare.running.run = fail_if_wide
    front, rear = cameras["front"], cameras["rear"]
    for failures in range(1, 6):
        front.send(wide)
        served.wait_for(lambda wanted=failures: front.counts()["failed"] >= wanted, "the failure")  # type: ignore[misc]
        rear.detect()
    assert served.state() == "active"
    assert "too wide" in front.values()["last problem"]


@pytest.mark.long
def test_a_camera_that_fails_faster_than_others_deliver_does_not_end_their_detection(
    served: ServedNode, prepare: Preparations, cameras: dict[str, CameraClient]
) -> None:
    served.bring_to("active")
    assert served.set(max_consecutive_failures=2) == (True, "")
    front, rear = cameras["front"], cameras["rear"]
    rear.detect()
    rear.wait_for(rear.send())
    prepare.running.run = fail
    served.wait_for(lambda: bool(front.send()) and front.counts()["failed"] > 4, "failures in a row")
    assert served.state() == "active"
    served.wait_for(
        lambda: bool(rear.send()) and served.node.state_label == "inactive", "the node to give up"
    )
    assert "failed frames in a row, the last: RuntimeError: the device is on fire" in served.status().message


def fail() -> np.ndarray:
    raise RuntimeError("the device is on fire")


def test_only_the_camera_that_somebody_looks_at_is_subscribed_to(served: ServedNode) -> None:
    front = CameraClient(served, "front")
    rear = CameraClient(served, "rear", is_listening=False)
    served.bring_to("active")
    front.detect()
    assert rear.images.get_subscription_count() == 0
    assert "no subscribers to ~/rear/detections or ~/rear/image" in served.statuses()["rear"].message
    rear.listen()
    rear.detect()


@pytest.mark.parametrize("state", ["inactive", "active"])
def test_other_cameras_need_another_configure(
    served: ServedNode, cameras: dict[str, CameraClient], state: str
) -> None:
    served.bring_to(state)
    done, reason = served.set(cameras=["rear", "left"])
    assert not done
    assert "ros2 lifecycle set /yolov5 deactivate; then ros2 lifecycle set /yolov5 cleanup" in reason
    assert served.set(cameras=[*CAMERAS]) == (True, ""), "as a dump of the node does"
    for label in ("deactivate", "cleanup") if state == "active" else ("cleanup",):
        assert served.transition(label)
    assert served.set(cameras=["rear", "left"]) == (True, "")
    served.bring_to("active")
    assert class_ids_of(CameraClient(served, "left").detect()) == ["cat"]
    assert set(served.statuses()) == {"detection", "rear", "left"}
    assert not any("/front/" in topic for topic in served_topics(served))


def test_a_node_changes_between_one_camera_without_a_name_and_several(served: ServedNode) -> None:
    assert served.set(cameras=[]) == (True, "")
    served.bring_to("active")
    assert class_ids_of(served.detect()) == ["cat"]
    assert set(served.statuses()) == {"detection"}


def test_cameras_whose_topics_are_remapped_to_one_name_are_refused(prepare: Preparations) -> None:
    remappings = ["--ros-args", "-r", "~/left/image:=/seen", "-r", "~/right/image:=/seen"]
    with ServedNode(prepare, parameters=["cameras:=[left, right]"], arguments=remappings) as served:
        assert not served.transition("configure")
        assert "~/left/image and ~/right/image are remapped to the same topic, /seen" in (
            served.status().message
        )


LONG = "a" * 64
LONG_NAMESPACE = f"/{'n' * 170}"
QOS_OF_FRONT = f"qos_overrides.{LONG_NAMESPACE}/yolov5/front/image_raw.subscription.depth:=2"


@pytest.mark.parametrize("overrides", [[], [QOS_OF_FRONT]], ids=["plain", "with a QoS override"])
def test_a_camera_whose_topics_would_have_too_long_names_fails_configure_until_it_is_renamed(
    prepare: Preparations, overrides: list[str]
) -> None:
    parameters, arguments = (
        [f"cameras:=[{LONG}]", *overrides],
        ["--ros-args", "-r", f"__ns:={LONG_NAMESPACE}"],
    )
    with ServedNode(prepare, parameters=parameters, arguments=arguments) as served:
        served.wait_for(lambda: bool(served.diagnostics), "diagnostics")
        assert served.node.trigger_configure() is TransitionCallbackReturn.FAILURE
        told = f"ROS refuses the full name of ~/{LONG}/detections"
        served.wait_for(lambda: told in served.diagnostics[-1].status[0].message, "the reason")
        assert served.set(cameras=["front"]) == (True, "")
        assert served.node.trigger_configure() is TransitionCallbackReturn.SUCCESS
    assert served.escaped == []


def test_a_new_model_serves_all_cameras_and_is_warmed_up_for_the_size_of_each(
    served: ServedNode, prepare: Preparations, cameras: dict[str, CameraClient]
) -> None:
    served.bring_to("active")
    wide = image(48, 128)
    cameras["rear"].send(wide)
    served.wait_for(lambda: bool(cameras["rear"].detections), "the wide image")
    assert served.set(image_size=320) == (True, "")
    assert prepare.sizes_hw == [[USUAL_SOURCE_HW] * 2, [USUAL_SOURCE_HW, (48, 128)]]
    prepare.running.run = lambda: prediction("dog", 0.9)
    assert [class_ids_of(camera.detect()) for camera in cameras.values()] == [["dog"], ["dog"]]


def test_ids_of_tracks_are_unique_among_cameras(served: ServedNode, cameras: dict[str, CameraClient]) -> None:
    assert served.set(tracker="bytetrack") == (True, "")
    served.bring_to("active")
    assert len({camera.track() for camera in cameras.values()}) == len(CAMERAS)
