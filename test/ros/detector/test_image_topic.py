"""Where images are expected: wrong remappings are refused or explained, a failed subscription is shown."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from typing import Literal

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.detector.image_topic import ImageTopic
from yolov5_lifecycle.ros.observer import Observer


@pytest.fixture
def node(ros_domain: int) -> Iterator[Observer]:
    with closing(Observer("viewer", domain=ros_domain)) as node:
        yield node


@pytest.mark.parametrize(
    ("rule", "told"),
    [
        pytest.param("~/image_raw:=/yolov5/detections", "~/detections and ~/image_raw", id="input-is-output"),
        pytest.param("~/image:=/yolov5/image_raw", "~/image and ~/image_raw", id="image-is-image-raw"),
        pytest.param(
            "~/image:=/yolov5/image_raw",
            "~/image/compressed and ~/image_raw/compressed",
            id="jpeg",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "~/label_info:=/yolov5/detections",
            "~/detections and ~/label_info",
            id="two-outputs",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "~/image_raw:=/diagnostics",
            "~/image_raw and /diagnostics",
            id="diagnostics",
            marks=pytest.mark.long,
        ),
        pytest.param(
            "~/detections:=/yolov5/image_raw/compressed",
            "~/detections and ~/image_raw/compressed",
            id="other-form",
        ),
    ],
)
def test_configure_refuses_topics_that_are_remapped_to_one(ros_domain: int, rule: str, told: str) -> None:
    with ServedNode(Preparations(), arguments=["--ros-args", "-r", rule]) as served:
        assert not served.transition("configure")
        assert served.state() == "unconfigured"
        status = served.status()
        assert status.level == DiagnosticStatus.ERROR
        assert f"{told} are remapped to the same topic" in status.message
        assert not served.escaped


def test_a_subscription_that_the_middleware_refuses_is_an_error_until_it_succeeds(ros_domain: int) -> None:
    """Fast DDS has one type for a topic in one process, and the client is in the node's."""
    with ServedNode(Preparations(), parameters=["lazy:=false"]) as served:
        assert served.transition("configure")
        assert served.transition("activate")
        other = served.client.create_publisher(String, "/yolov5/image_raw/compressed", 1)
        assert served.set(image_transport="compressed") == (True, "")
        assert served.get("image_transport") == "compressed"
        status = served.status()
        assert status.level == DiagnosticStatus.ERROR
        assert "cannot subscribe to /yolov5/image_raw/compressed: " in status.message
        served.wait_for_log("cannot subscribe to /yolov5/image_raw/compressed: ")
        assert served.state() == "active"
        served.client.destroy_publisher(other)
        served.wait_for(lambda: served.status().level != DiagnosticStatus.ERROR, "the subscription")
        assert sum("cannot subscribe" in said for said in served.log) == 1
        assert not served.escaped


def test_an_idle_node_names_its_topic_and_the_one_that_was_meant(ros_domain: int) -> None:
    arguments = ["--ros-args", "-r", "~/image_raw:=/camera/image"]
    with ServedNode(Preparations(), arguments=arguments) as served:
        served.wait_for(lambda: bool(served.values()["other topics with images"]), "the other topic")
        values = served.values()
    assert (values["image topic"], values["image publishers"]) == ("/camera/image", "0")
    assert values["other topics with images"] == "/yolov5/image_raw"


def test_publishers_of_images_and_of_other_types_are_distinguished(node: Observer) -> None:
    topic = ImageTopic(node, "raw")
    node.create_publisher(String, "/viewer/elsewhere", 1)
    with closing(Observer("other", domain=int(node.context.get_domain_id()))) as other:
        other.create_publisher(String, "/viewer/image_raw", 1)
        node.wait_for(lambda: bool(topic.look().other_types), "the other type")
        status = topic.look()
        assert (status.publishers, status.other_types) == (0, ("std_msgs/msg/String",))


def test_the_time_without_a_publisher_grows_until_one_is_there(node: Observer) -> None:
    now_s = 100.0
    topic = ImageTopic(node, "raw", clock=lambda: now_s)
    assert topic.look().missing_s == 0.0
    now_s = 103.0
    assert topic.look().missing_s == 3.0
    publisher = node.create_publisher(Image, "/viewer/image_raw", QoSProfile(depth=1))
    node.wait_for(lambda: topic.look().publishers == 1, "the publisher")
    assert topic.look().missing_s == 0.0
    node.destroy_publisher(publisher)
    node.wait_for(lambda: topic.look().publishers == 0, "the publisher to leave")
    now_s = 104.0
    assert topic.look().missing_s == 1.0


def test_topics_with_images_are_searched_seldom_and_only_those_with_publishers_are_named(
    node: Observer,
) -> None:
    now_s = 0.0
    topic = ImageTopic(node, "raw", clock=lambda: now_s)
    node.create_subscription(Image, "/viewer/image_row", lambda _: None, 1)
    node.create_publisher(Image, "/viewer/image", 1)  # where the node itself publishes
    assert topic.look().similar == ()
    for number in range(5):
        node.create_publisher(Image, f"/viewer/{'x' * number}image_raw_{number}", 1)
    node.create_publisher(CompressedImage, "/viewer/image_raw/compressed", 1)
    node.wait_for(lambda: node.count_publishers("/viewer/image_raw/compressed") == 1, "the publisher")
    assert topic.look().similar == ()
    now_s = 5.0
    similar = topic.look().similar
    assert similar[:2] == ("/viewer/image_raw/compressed", "/viewer/image_raw_0")  # the same camera first
    assert len(similar) == 3
    assert not {"/viewer/image", "/viewer/image_row"} & set(similar)


@pytest.mark.parametrize("transport", ["raw", "compressed"])
def test_images_of_labels_and_distances_are_not_offered_instead_of_a_camera(
    node: Observer, transport: Literal["raw", "compressed"]
) -> None:
    topic = ImageTopic(node, transport)
    others = ("masks", "ground_truth_masks", "label_image", "segmentation/image_raw", "depth/image_raw")
    for name in (*others, "labelled_image"):
        node.create_publisher(Image, f"/other/{name}", 1)
    node.wait_for(lambda: node.count_publishers("/other/labelled_image") == 1, "the publishers")
    assert topic.look().similar == ("/other/labelled_image",)


def test_an_image_of_labels_is_offered_where_one_is_expected(ros_domain: int) -> None:
    with closing(Observer("labels", domain=ros_domain)) as node:
        node.create_publisher(Image, "/other/labels", 1)
        node.wait_for(lambda: node.count_publishers("/other/labels") == 1, "the publisher")
        assert ImageTopic(node, "raw").look().similar == ("/other/labels",)
