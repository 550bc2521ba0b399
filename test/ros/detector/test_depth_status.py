"""Why detections have no place in space, and how it is reported."""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

import pytest
from support.good_status import GOOD, GOOD_CAMERA, SOURCE

from yolov5_lifecycle.ros.detector.depth import UNPLACED_S, DepthCounts, DepthStatus, RunWithoutDepth
from yolov5_lifecycle.ros.detector.image_topic import DISCOVERY_S
from yolov5_lifecycle.spatial.placement import Unplaced

IMAGE = SOURCE
INFO = dataclasses.replace(SOURCE, name="/yolov5/depth/camera_info")
REJECTION = "depth images are rejected: Expected a depth image in 16UC1 or 32FC1, found encoding 'rgb8'."
REASON = "no depth image: no depth image has been received"
LONG_RUN = RunWithoutDepth(REASON, begun_s=5.0, ended_s=5.5 + UNPLACED_S)


def depth(**changes: Any) -> DepthStatus:
    good = DepthStatus(image=IMAGE, camera_info=INFO, counts=DepthCounts(), run=None, recently_rejected="")
    return dataclasses.replace(good, **changes)


def refused(topic: str) -> dict[str, Any]:
    return {"problem": f"cannot subscribe to {topic}: out of memory"}


def missing(seconds: float = DISCOVERY_S + 1) -> dict[str, Any]:
    return {"publishers": 0, "missing_s": seconds}


@pytest.mark.parametrize(
    ("status", "hint"),
    [
        pytest.param(depth(), "", id="all-is-well"),
        pytest.param(depth(image=None, camera_info=None, run=LONG_RUN), "", id="nobody-needs-it"),
        pytest.param(
            depth(image=dataclasses.replace(IMAGE, **refused(IMAGE.name), **missing())),
            "cannot subscribe to /yolov5/depth/image_raw: out of memory: detections have no place in space",
            id="refused-images",
        ),
        pytest.param(
            depth(camera_info=dataclasses.replace(INFO, **refused(INFO.name))),
            "cannot subscribe to /yolov5/depth/camera_info: out of memory: detections have no place in space",
            id="refused-camera-info",
        ),
        pytest.param(
            depth(image=dataclasses.replace(IMAGE, **missing()), recently_rejected=REJECTION),
            "no publisher of depth images on /yolov5/depth/image_raw: detections have no place in space; "
            "start the depth camera, remap the topic or set depth to false",
            id="no-images",
        ),
        pytest.param(
            depth(image=dataclasses.replace(IMAGE, **missing(), sent_as="/a", remedy="type `this`")),
            "no publisher of depth images on /yolov5/depth/image_raw (but in another form on /a): detections "
            "have no place in space; type `this`",
            id="images-in-another-form",
        ),
        pytest.param(
            depth(camera_info=dataclasses.replace(INFO, **missing()), recently_rejected=REJECTION),
            "no publisher of its camera_info on /yolov5/depth/camera_info: detections have no place in "
            "space; start the depth camera, remap the topic or set depth to false",
            id="no-camera-info",
        ),
        pytest.param(
            depth(
                image=dataclasses.replace(IMAGE, **missing(DISCOVERY_S)),
                camera_info=dataclasses.replace(INFO, **missing(DISCOVERY_S)),
            ),
            "",
            id="not-discovered-yet",
        ),
        pytest.param(
            depth(recently_rejected=REJECTION, run=LONG_RUN),
            f"detections have no place in space: {REJECTION}",
            id="rejected",
        ),
        pytest.param(depth(run=LONG_RUN), f"detections have no place in space: {REASON}", id="unplaced"),
        pytest.param(
            depth(run=dataclasses.replace(LONG_RUN, ended_s=5.0 + UNPLACED_S)), "", id="unplaced-for-a-moment"
        ),
    ],
)
def test_the_most_pressing_reason_without_a_place_is_told(status: DepthStatus, hint: str) -> None:
    assert status.hint == hint
    camera = dataclasses.replace(GOOD_CAMERA, depth_status=status)
    assert dataclasses.replace(GOOD, cameras=(camera,)).of_node.message == (hint or "detecting")


def test_what_is_wrong_with_the_images_is_told_before_depth() -> None:
    status = depth(run=LONG_RUN)
    camera = dataclasses.replace(GOOD_CAMERA, depth_status=status, recent_failure="images are rejected")
    assert camera.hint == "images are rejected"


def test_the_values_hold_every_count() -> None:
    counts = DepthCounts(
        depth_images=9,
        rejected_depth_images=2,
        rejected_camera_infos=3,
        placed_images=4,
        unplaced_images=5,
        placed=6,
        unplaced=Counter({reason: 10 + number for number, reason in enumerate(Unplaced)}),
    )
    assert depth(counts=counts).values() == {
        "depth topic": "/yolov5/depth/image_raw",
        "depth publishers": "1",
        "camera_info publishers": "1",
        "depth images received": "9",
        "depth images rejected": "2",
        "camera_infos rejected": "3",
        "images with depth": "4",
        "images without depth": "5",
        "detections placed": "6",
        "unplaced: no depth image": "10",
        "unplaced: no camera_info": "11",
        "unplaced: other size": "12",
        "unplaced: no valid depth in box": "13",
    }


def test_while_nobody_needs_depth_its_topics_have_no_values() -> None:
    values = depth(image=None, camera_info=None).values()
    assert not {"depth topic", "depth publishers", "camera_info publishers"} & set(values)
    assert values["depth images received"] == "0"
