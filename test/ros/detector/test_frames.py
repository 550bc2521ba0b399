"""One frame: detected, rejected, failed or skipped, and counted."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from support.preparations import Preparations, prediction
from support.served_node import PATIENCE_S, ServedNode, class_ids_of, image

from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S, abandoned


def test_a_rejected_image_is_counted_and_the_next_one_detected(served: ServedNode) -> None:
    served.bring_to("active")
    served.publish(image(encoding="nonsense"))
    served.wait_for(lambda: "'nonsense' is not supported" in served.status().message, "the rejection")
    assert served.counts()["rejected"] == 1
    assert class_ids_of(served.detect()) == ["cat"]
    counts = served.counts()
    assert counts.pop("received") == sum(counts.values())


def test_an_image_with_a_long_frame_id_is_rejected_before_it_is_detected(
    served: ServedNode, prepare: Preparations
) -> None:
    served.bring_to("active")
    long = image()
    long.header.frame_id = "x" * 1_000_000
    served.publish(long)
    reason = "Expected a frame_id of at most 256 characters, found 1000000. Correct it in the driver"
    served.wait_for(lambda: reason in served.status().message, "the rejection")
    assert served.counts()["rejected"] == 1
    assert not served.detections
    assert not prepare.running.calls


@pytest.mark.long
def test_rejected_images_do_not_flood_the_log(served: ServedNode) -> None:
    served.bring_to("active")
    begun_s = time.monotonic()

    def are_rejected() -> bool:
        served.images.publish(image(encoding="nonsense"))
        values = {item.key: item.value for item in served.diagnostics[-1].status[0].values}
        return int(values["frames rejected"]) >= 100

    served.status()
    served.wait_for(are_rejected, "a hundred rejections")
    counts = served.counts()
    assert counts["received"] == counts["rejected"] + counts["stale"] + counts["pending"]
    assert not served.transition("nonsense")
    served.wait_for_log("'nonsense' refused")
    most = (time.monotonic() - begun_s) / 5 + 1
    assert 1 <= sum("image rejected: " in said for said in served.log) <= most


def fail() -> np.ndarray:
    raise RuntimeError("the device is on fire")


def test_failures_in_a_row_deactivate_the_node_with_the_reason(
    served: ServedNode, prepare: Preparations
) -> None:
    served.bring_to("active")
    assert served.set(max_consecutive_failures=2) == (True, "")
    prepare.running.run = fail
    served.send_until(lambda: served.node.state_label == "inactive", "the node to give up")
    status = served.status()
    assert status.message == "deactivated after 2 failed frames in a row, the last: " + (
        "RuntimeError: the device is on fire"
    )
    assert status.level == DiagnosticStatus.ERROR
    assert prepare.running.is_closed
    assert served.transition("activate")
    assert class_ids_of(served.detect()) == ["cat"]
    assert served.status().level != DiagnosticStatus.ERROR


def test_a_detected_frame_ends_the_count_of_failures(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    assert served.set(max_consecutive_failures=2) == (True, "")
    runtime = prepare.running

    def fail_every_other_time() -> np.ndarray:
        return fail() if len(runtime.calls) % 2 else prediction("cat", 0.9)

    runtime.run = fail_every_other_time
    served.send_until(lambda: len(runtime.calls) >= 8, "eight frames")
    assert served.state() == "active"


def test_a_hung_inference_does_not_block_deactivate(served: ServedNode, prepare: Preparations) -> None:
    served.bring_to("active")
    entered, release = threading.Event(), threading.Event()

    def hang() -> np.ndarray:
        entered.set()
        release.wait(10 * PATIENCE_S)
        return prediction("cat", 0.9)

    prepare.running.run = hang
    served.publish()
    served.wait_for(entered.is_set, "inference to hang")
    assert served.state() == "active"
    hint = "s so far. If inference hangs, deactivate and activate the node"
    served.wait_for(lambda: hint in served.status().message, "the hint")
    served.wait_for_log(hint)
    assert served.transition("deactivate"), "although inference still hangs"
    given_up = abandoned(REST_TIMEOUT_S)
    assert served.status().message == given_up
    served.wait_for_log(given_up)
    release.set()
    assert served.transition("activate")
    assert class_ids_of(served.detect()) == ["cat"]


def test_detections_carry_the_header_of_their_image(served: ServedNode) -> None:
    served.bring_to("active")
    message = image()
    message.header.frame_id = "front"
    message.header.stamp.sec, message.header.stamp.nanosec = 12, 34
    served.publish(message)
    served.wait_for(lambda: bool(served.detections), "a detection")
    array = served.detections[0]
    assert array.header == message.header
    assert [detection.header for detection in array.detections] == [message.header]
    assert array.detections[0].id == ""
    assert (array.detections[0].bbox.size_x, array.detections[0].bbox.size_y) == pytest.approx((2, 1))


def test_a_rate_limit_skips_and_counts_the_frames_between(served: ServedNode) -> None:
    served.bring_to("active")
    assert served.set(max_rate=1.0) == (True, "")
    served.detect()
    served.send_until(lambda: served.counts()["skipped"] > 0, "an image that comes too early")
    counts = served.counts()
    assert counts["received"] == sum(counts.values()) - counts["received"]
