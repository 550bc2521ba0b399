"""What the node subscribes to and publishes, and how it is reported."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from support.preparations import Preparations
from support.served_node import ServedNode, class_ids_of, image

from yolov5_lifecycle.ros.messages import image_of_message


def test_labels_are_latched_with_the_current_threshold(served: ServedNode) -> None:
    served.bring_to("active")
    info = served.label_info()
    assert [(label.class_id, label.class_name) for label in info.class_map] == [(0, "cat"), (1, "dog")]
    assert info.threshold == pytest.approx(0.25)
    served.set(confidence_threshold=0.5)
    assert served.label_info().threshold == pytest.approx(0.5)


def test_without_subscribers_a_lazy_node_does_not_subscribe(served: ServedNode) -> None:
    served.bring_to("active")
    served.publish()
    for subscription in list(served.client.subscriptions):
        if subscription.topic == "/yolov5/detections":
            served.client.destroy_subscription(subscription)
    served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")
    assert "no subscribers" in served.status().message
    assert served.set(lazy=False) == (True, "")
    served.wait_for(lambda: served.image_subscriptions() == 1, "the node to subscribe")


def test_diagnostics_come_in_every_state(served: ServedNode) -> None:
    assert served.status().message.startswith("unconfigured: ")
    served.bring_to("active")
    assert served.state() == "active"
    values = served.values()
    assert values["state"] == "active"
    assert values["runtime"] == "scripted"
    assert values["sha256"] == "0" * 64


@pytest.mark.long
def test_each_reason_for_missing_detections_is_reported_while_it_lasts(prepare: Preparations) -> None:
    with ServedNode(prepare, arguments=["--ros-args", "-r", "~/image_raw:=/front"]) as served:

        def is_told(reason: str) -> Callable[[], bool]:
            return lambda: reason in served.status().message

        served.bring_to("active")
        served.wait_for(is_told("no publisher of images on /front"), "the missing camera")
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        camera = served.client.create_publisher(Image, "/front", best_effort)
        assert served.set(image_reliability="reliable") == (True, "")
        served.wait_for(is_told("a best-effort publisher on /front does not match"), "the mismatch")
        assert served.set(image_reliability="auto") == (True, "")
        assert served.set(confidence_threshold=0.95) == (True, "")

        def is_empty() -> bool:
            camera.publish(image())
            return int(served.values()["empty frames in a row"]) > 0

        served.wait_for(is_empty, "a frame without detections")
        assert served.values()["best score in them"] == "0.9"


def test_a_compressed_camera_is_understood(served: ServedNode) -> None:
    served.bring_to("active")
    assert served.set(image_transport="compressed") == (True, "")
    done, data = cv2.imencode(".jpg", np.full((48, 64, 3), 114, np.uint8))
    assert done
    message = CompressedImage(format="jpeg", data=data.tobytes())
    publisher = served.client.create_publisher(CompressedImage, "/yolov5/image_raw/compressed", 1)

    def is_detected() -> bool:
        publisher.publish(message)
        return bool(served.detections)

    served.wait_for(is_detected, "a detection")
    assert class_ids_of(served.detections[-1]) == ["cat"]


def test_a_subscriber_to_the_compressed_image_alone_gets_it(served: ServedNode) -> None:
    served.bring_to("active")
    drawn: list[CompressedImage] = []
    served.client.create_subscription(CompressedImage, "/yolov5/image/compressed", drawn.append, 1)
    for subscription in list(served.client.subscriptions):
        if subscription.topic == "/yolov5/detections":
            served.client.destroy_subscription(subscription)
    served.send_until(lambda: bool(drawn), "a compressed image")
    assert image_of_message(drawn[0]).size_hw == (48, 64)


def test_the_subscription_takes_the_reliability_that_the_cameras_offer(served: ServedNode) -> None:
    served.bring_to("active")
    served.detect()
    served.wait_for(lambda: served.values()["image reliability"] == "reliable", "a reliable subscription")
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    served.client.create_publisher(Image, "/yolov5/image_raw", best_effort)
    served.wait_for(lambda: served.values()["image reliability"] == "best_effort", "best effort")
    assert class_ids_of(served.detect()) == ["cat"]


def test_the_compressed_topic_follows_the_remapped_raw_one(prepare: Preparations) -> None:
    arguments = ["--ros-args", "-r", "~/image_raw:=/front/image"]
    with ServedNode(prepare, parameters=["image_transport:=compressed"], arguments=arguments) as served:
        served.bring_to("active")
        assert served.values()["image topic"] == "/front/image/compressed"
