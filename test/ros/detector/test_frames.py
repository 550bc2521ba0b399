"""One frame: received, detected, rejected, failed or skipped, counted and published."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from support.preparations import Preparations, prediction
from support.served_node import ServedNode, class_ids_of, image


def fail() -> np.ndarray:
    raise RuntimeError("the device is on fire")


def test_failures_in_a_row_deactivate_the_node_with_the_reason(
    active: ServedNode, prepare: Preparations
) -> None:
    assert active.set(max_consecutive_failures=2) == (True, "")
    runtime = prepare.running

    def fail_every_other_time() -> np.ndarray:
        return fail() if len(runtime.calls) % 2 else prediction("cat", 0.9)

    runtime.run = fail_every_other_time
    active.send_until(lambda: len(runtime.calls) >= 8, "eight frames, of which no two in a row fail")
    assert active.state() == "active"
    runtime.run = fail
    active.send_until(lambda: active.node.state_label == "inactive", "the node to give up")
    status = active.status()
    assert status.message == "deactivated after 2 failed frames in a row, the last: " + (
        "RuntimeError: the device is on fire"
    )
    assert status.level == DiagnosticStatus.ERROR
    assert runtime.is_closed
    assert active.transition("activate")
    assert class_ids_of(active.detect()) == ["cat"]
    assert active.status().level != DiagnosticStatus.ERROR


def test_a_rate_limit_skips_and_counts_the_frames_between(active: ServedNode) -> None:
    assert active.set(max_rate=1.0) == (True, "")
    active.detect()
    active.send_until(lambda: active.counts()["skipped"] > 0, "an image that comes too early")
    counts = active.counts()
    assert counts["received"] == sum(counts.values()) - counts["received"]


def test_without_subscribers_a_lazy_node_does_not_subscribe(served: ServedNode) -> None:
    assert served.status().message.startswith("unconfigured: ")
    served.bring_to("active")
    served.publish()
    served.ignore_detections()
    served.wait_for(lambda: served.image_subscriptions() == 0, "the node to unsubscribe")
    status = served.status()
    assert status.message.endswith("no subscribers to ~/detections or ~/image, so no images are received")
    values = {item.key: item.value for item in status.values}
    assert (values["state"], values["runtime"], values["sha256"]) == ("active", "scripted", "0" * 64)
    assert served.set(lazy=False) == (True, "")
    served.wait_for(lambda: served.image_subscriptions() == 1, "the node to subscribe")


def test_the_subscription_takes_the_reliability_that_all_cameras_offer_unless_another_is_set(
    prepare: Preparations,
) -> None:
    arguments = ["--ros-args", "-r", "~/image_raw:=/front/image"]
    with ServedNode(prepare, arguments=arguments) as served:
        reliable = served.client.create_publisher(Image, "/front/image", 1)
        served.bring_to("active")
        served.wait_for(lambda: served.values()["image reliability"] == "reliable", "a reliable subscription")
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        camera = served.client.create_publisher(Image, "/front/image", best_effort)
        served.wait_for(lambda: served.values()["image reliability"] == "best_effort", "best effort")
        served.client.destroy_publisher(reliable)
        assert served.set(image_reliability="reliable") == (True, "")
        told = "a best-effort publisher on /front/image does not match"
        served.wait_for(lambda: told in served.status().message, "the mismatch")
        assert served.set(image_reliability="auto", confidence_threshold=0.95) == (True, "")

        def is_empty() -> bool:
            camera.publish(image())
            return int(served.values()["empty frames in a row"]) > 0

        served.wait_for(is_empty, "a frame without detections")
        assert served.values()["best score in them"] == "0.9"
        assert served.set(image_transport="compressed") == (True, "")
        assert served.values()["image topic"] == "/front/image/compressed"
