"""The node gives objects identities while a tracker is chosen."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from support.preparations import Preparations
from support.served_node import ServedNode, image
from vision_msgs.msg import Detection2DArray

PARAMETERS = ("tracker:=bytetrack", "track_timeout:=60.0")
LIVE: list[dict[str, object]] = [
    {"confidence_threshold": 0.4},
    {"track_high_threshold": 0.3, "track_low_threshold": 0.2},
    {"track_across_classes": True},
    {"track_camera_motion": "off"},
    {"classes": ["cat"]},
]


@pytest.fixture
def tracking(prepare: Preparations) -> Iterator[ServedNode]:
    with ServedNode(prepare, parameters=PARAMETERS) as served:
        served.bring_to("active")
        yield served


def see(served: ServedNode, sec: int) -> Detection2DArray:
    """What is published for an image taken at `sec`."""
    message = image()
    message.header.stamp.sec = sec
    served.publish(message)
    served.wait_for(
        lambda: bool(served.detections) and served.detections[-1].header == message.header, "the detections"
    )
    return served.detections[-1]


def ids_at(served: ServedNode, *stamps_s: int) -> list[str]:
    """The ids that the only object has in images taken at `stamps_s`."""
    return [detection.id for sec in stamps_s for detection in see(served, sec).detections]


def wait_until_unsubscribed(served: ServedNode) -> None:
    """Before the node subscribes again, so that the next image goes to the new subscription."""
    served.wait_for(lambda: served.images.get_subscription_count() == 0, "the end of the subscription")


def test_an_object_has_an_id_from_its_second_image_on_which_live_changes_keep(tracking: ServedNode) -> None:
    assert ids_at(tracking, 1, 2, 3) == ["", "1", "1"]
    values = tracking.values()
    assert (values["tracker"], values["confirmed tracks"]) == ("bytetrack", "1")
    for sec, change in enumerate(LIVE, start=4):
        assert tracking.set(**change) == (True, "")
        assert ids_at(tracking, sec) == ["1"], change
    assert tracking.set(track_timeout=0.5) == (True, "")
    assert ids_at(tracking, 20, 21) == ["", ""]


def test_tracking_begins_and_ends_with_the_next_image(active: ServedNode) -> None:
    assert ids_at(active, 1, 2) == ["", ""]
    assert "tracker" not in active.values()
    for first_id, sec in (("1", 10), ("2", 20)):
        assert active.set(tracker="bytetrack", track_timeout=60.0) == (True, "")
        assert ids_at(active, sec, sec + 1) == ["", first_id]
        assert active.set(tracker="none") == (True, "")
        assert ids_at(active, sec + 2) == [""]


def test_a_reload_starts_afresh_and_reuses_no_id(tracking: ServedNode) -> None:
    ids_at(tracking, 1, 2)
    before = see(tracking, 3).detections[0].bbox
    assert tracking.set(precision="bf16") == (True, "")
    after = see(tracking, 4).detections[0]
    assert (after.id, after.bbox) == ("", before)  # a tracker that was kept would give it the id 1
    assert ids_at(tracking, 5, 4) == ["2", ""]
    assert tracking.values()["late images not tracked"] == "1"
    assert tracking.set(precision="auto") == (True, "")
    ids_at(tracking, 20, 19)
    assert tracking.values()["late images not tracked"] == "2", "those before the reload count"


def test_activating_again_or_another_transport_starts_afresh_and_reuses_no_id(
    tracking: ServedNode,
) -> None:
    ids_at(tracking, 1, 2)
    assert tracking.transition("deactivate")
    wait_until_unsubscribed(tracking)
    assert tracking.transition("activate")
    assert ids_at(tracking, 3, 4) == ["", "2"]
    assert tracking.set(image_transport="compressed") == (True, "")
    wait_until_unsubscribed(tracking)
    assert tracking.set(image_transport="raw") == (True, "")
    assert ids_at(tracking, 5, 6) == ["", "3"]


def test_a_late_image_has_no_ids_and_a_stamp_that_goes_far_back_starts_afresh(tracking: ServedNode) -> None:
    before = tracking.counts()
    assert ids_at(tracking, 10, 11, 10, 12, 5, 6) == ["", "1", "", "1", "", "2"]
    values, counts = tracking.values(), tracking.counts()
    assert (values["late images not tracked"], values["jumps back in time"]) == ("1", "1")
    assert counts["detected"] - before["detected"] == counts["received"] - before["received"] == 6
    tracking.wait_for_log("the stamps of the images went back by 7.0 s: tracking begins again")
    assert sum("went back" in said for said in tracking.log) == 1
