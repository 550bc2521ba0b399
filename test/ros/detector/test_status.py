"""Why an active node publishes nothing, or nothing in space, and how it is reported."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Log
from rclpy.qos import QoSProfile, ReliabilityPolicy

from yolov5_lifecycle.collecting.collector import CollectorStatus
from yolov5_lifecycle.ros.detector.camera_topic import DISCOVERY_S, TopicStatus
from yolov5_lifecycle.ros.detector.depth import RECENT_S, UNPLACED_S, DepthInput, RunWithoutDepth
from yolov5_lifecycle.ros.detector.diagnostics import (
    EMPTY_S,
    SILENCE_S,
    SLOW_S,
    CameraStatus,
    Diagnostics,
    Status,
)
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import EmptyRun, FrameCounter, LatencySummary, Outcome

SMALL, LARGE = 230_400, 921_600
NOW_S = 100.0
INPUT: dict[str, Any] = {
    "reliability": ReliabilityPolicy.BEST_EFFORT,
    "silent_s": 0.1,
    "recent": lambda: (150, 1, 4.2),
    "max_bytes": LARGE,
    "losses": SimpleNamespace(lost=3, dropped_in_queue=7),
}
OFFERS = (QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),)
SOURCE = TopicStatus("/yolov5/depth/image_raw", OFFERS)
INFO = TopicStatus("/yolov5/depth/camera_info", OFFERS)


def subscription(topic: TopicStatus) -> Any:
    return SimpleNamespace(topic=SimpleNamespace(look=lambda: topic))


def depth_input(
    *subscriptions: Any,
    rejection: str = "",
    run: RunWithoutDepth | None = None,
    counts: Mapping[str, int] = MappingProxyType({}),
) -> DepthInput:
    """With these subscriptions, to depth images and camera_info, and the last rejection a moment ago."""
    depth = DepthInput(None, slop_s=0.05, clock=lambda: NOW_S)
    depth._subscriptions = [*subscriptions]
    depth.run, depth.counts = run, {**counts}
    if rejection:
        depth.rejection, depth.rejected_s = rejection, NOW_S - RECENT_S / 2
    return depth


ACTIVE: dict[str, Any] = {
    "settings": Settings(confidence_threshold=0.9),
    "session": SimpleNamespace(model=SimpleNamespace(detector=SimpleNamespace(segments=True))),
    "input": SimpleNamespace(**INPUT),
    "depth": depth_input(subscription(SOURCE), subscription(INFO)),
    "latencies": SimpleNamespace(summary=lambda _: LatencySummary(29.9, 21.0, 30.5)),
    "empty_frames": SimpleNamespace(run=EmptyRun()),
    "tracker_values": lambda: {"tracker": "bytetrack"},
    "busy_s": 0.0,
    "frame": None,
    "collecting_problem": "",
}
CAMERA: dict[str, Any] = {
    "name": "",
    "counter": FrameCounter(),
    "outputs": SimpleNamespace(subscribers_in_space={"~/detections_3d": 1}, mask_subscribers=1),
    "last_problem": ("", 0.0),
    "recent_failure": "",
}
TOPIC = TopicStatus("/yolov5/image_raw", OFFERS)
NO_CAMERA = TopicStatus(name="/yolov5/image_raw", missing_s=DISCOVERY_S + 1)
BLIND_RUN = EmptyRun(frames=152, begun_s=5.0, ended_s=6.0 + EMPTY_S, best_missed=0.614)
IDLE = "idle (lazy): no subscribers to ~/detections or ~/image, so no images are received"
LAZY = SimpleNamespace(**INPUT | {"reliability": None})
NO_MASKS = SimpleNamespace(model=SimpleNamespace(detector=SimpleNamespace(segments=False)))
UNWATCHED = SimpleNamespace(subscribers_in_space={"~/points": 1}, mask_subscribers=0)


def with_camera(topic: TopicStatus = TOPIC, **changes: Any) -> Status:
    """Of an active node whose one camera is well but for `changes`, of CAMERA or of ACTIVE."""
    active = ACTIVE | {name: value for name, value in changes.items() if name in ACTIVE}
    camera = CAMERA | {name: value for name, value in changes.items() if name in CAMERA}
    assert len(changes) == len(changes.keys() & {*ACTIVE, *CAMERA})
    camera["active"] = SimpleNamespace(**active)
    return Status(
        state="active",
        problem="",
        settings=Settings(),
        model=None,
        cameras=(CameraStatus(SimpleNamespace(**camera), topic),),  # type: ignore[arg-type]
        abandoned_threads=0,
        resident_mb=350.4,
        collected=CollectorStatus(kept=3, duplicates=5, frames=12, megabytes=4.2),
    )


def with_topic(**changes: Any) -> Status:
    return with_camera(replace(NO_CAMERA, **changes))


def with_input(**changes: Any) -> Status:
    return with_camera(input=SimpleNamespace(**INPUT | changes))


def with_empty(**changes: Any) -> Status:
    return with_camera(empty_frames=SimpleNamespace(run=replace(BLIND_RUN, **changes)))


def losing(received: int, lost: int, max_bytes: int = LARGE) -> Status:
    return with_input(recent=lambda: (received, lost, 4.2), max_bytes=max_bytes)


GOOD = with_camera()
BLIND = with_empty()
OF_CLASSES = Settings(confidence_threshold=0.9, class_thresholds=("person: 0.8",))


@pytest.mark.parametrize(
    ("status", "told"),
    [
        pytest.param(GOOD, "detecting", id="detecting"),
        pytest.param(
            losing(30, 10),
            "10 of 40 images were lost between the camera and this node in the last 4 s; images of 0.9 MB do",
            id="losses",
        ),
        pytest.param(
            losing(30, 10, SMALL),
            "overloaded. Lower the camera's rate",
            id="small-losses",
        ),
        pytest.param(losing(3, 4), "detecting", id="too-few-images-to-judge"),
        pytest.param(with_topic(missing_s=DISCOVERY_S), "waiting for a publisher of images", id="discovery"),
        pytest.param(
            with_topic(sent_as="/a/compressed", remedy="type `this`", similar=("/a/compressed", "/b")),
            "/yolov5/image_raw. They are published in another form, on /a/compressed: type `this`",
            id="another-form",
        ),
        pytest.param(
            with_topic(similar=("/a", "/b"), remedy="type `this`"),
            "Images are published on /a and /b: did you mean that? For /a, type `this`",
            id="other-topics-with-remedy",
        ),
        pytest.param(
            with_topic(other_types=("std_msgs/msg/String",)),
            "no publisher of images on /yolov5/image_raw (but std_msgs/msg/String)",
            id="another-type",
        ),
        pytest.param(
            with_input(reliability=ReliabilityPolicy.RELIABLE),
            "a best-effort publisher on /yolov5/image_raw does not match this reliable subscription: set "
            "image_reliability to auto or best_effort",
            id="incompatible-quality",
        ),
        pytest.param(
            with_input(silent_s=SILENCE_S + 5), "no image on /yolov5/image_raw for 7 s", id="silence"
        ),
        pytest.param(
            with_camera(busy_s=SLOW_S + 1), "inference of one image takes more than 2 s", id="hanging"
        ),
        pytest.param(
            with_camera(recent_failure="images are rejected: x", collecting_problem="full", session=NO_MASKS),
            "images are rejected: x",
            id="trouble-before-remarks",
        ),
        pytest.param(
            with_camera(collecting_problem="full"), "no images are collected: full", id="not-collected"
        ),
        pytest.param(
            with_camera(replace(NO_CAMERA, similar=("/front/image_raw",)), input=LAZY),
            f"{IDLE}; no publisher of images on /yolov5/image_raw: start the camera or remap the topic. "
            "Images are published on /front/image_raw: did you mean that?",
            id="lazy-and-remapped-wrongly",
        ),
        pytest.param(
            BLIND,
            "No detection in 152 frames: best score 0.61, confidence_threshold 0.9. Lower the threshold, or "
            "clear classes",
            id="below-threshold",
        ),
        pytest.param(
            with_camera(empty_frames=SimpleNamespace(run=BLIND_RUN), settings=OF_CLASSES),
            "No detection in 152 frames: best score 0.61, confidence_threshold 0.9 and class_thresholds. "
            "Lower the thresholds, or clear classes",
            id="below-thresholds-of-classes",
        ),
        pytest.param(
            with_empty(best_missed=0.0),
            "No detection in 152 frames: no score above 0.05. Check the images, image_size and weights, or "
            "clear classes",
            id="nothing-above-noise",
        ),
        pytest.param(
            with_empty(best_filtered=0.956),
            "Objects are found (best 0.96), but all are filtered out: check regions, ignore_regions, "
            "min_box_size, max_box_size",
            id="all-filtered",
        ),
        pytest.param(
            with_camera(session=NO_MASKS),
            "~/masks has a subscriber, but the loaded model does not segment: load a segmentation model, "
            "such as yolov5n-seg.pt, with weights",
            id="masks-of-a-model-without",
        ),
        pytest.param(with_camera(session=NO_MASKS, outputs=UNWATCHED), "detecting", id="no-masks-wanted"),
        pytest.param(
            with_camera(depth=None),
            "~/detections_3d has a subscriber, but nothing is published on it: set depth to true",
            id="depth-is-off",
        ),
        pytest.param(
            with_camera(depth=None, outputs=UNWATCHED),
            "~/points has a subscriber, but nothing is published on it: set depth to true",
            id="depth-is-off-for-points",
        ),
        pytest.param(
            replace(GOOD, state="unconfigured"),
            "unconfigured: configure and activate the node to detect",
            id="unconfigured",
        ),
        pytest.param(
            replace(with_topic(), state="inactive"), "inactive: activate the node to detect", id="inactive"
        ),
        pytest.param(replace(GOOD, state="finalized"), "finalized", id="any-other-state"),
        pytest.param(replace(GOOD, problem="no weights"), "no weights", id="problem-first"),
        pytest.param(
            replace(with_camera(NO_CAMERA, name="front"), namesakes="2 nodes"),
            "2 nodes",
            id="namesakes-before-images",
        ),
    ],
)
def test_the_message_is_the_most_pressing_thing(status: Status, told: str) -> None:
    assert told in status.of_node.message


@pytest.mark.parametrize(
    "status",
    [
        pytest.param(GOOD, id="all-is-well"),
        pytest.param(with_camera(input=LAZY), id="lazy"),
        pytest.param(with_topic(missing_s=DISCOVERY_S), id="discovery"),
        pytest.param(BLIND, id="nothing-to-see"),
        pytest.param(replace(with_topic(), state="inactive"), id="inactive"),
    ],
)
def test_what_is_no_trouble_is_no_warning(status: Status) -> None:
    assert status.of_node.level == DiagnosticStatus.OK


REJECTION = "depth images are rejected: Expected a depth image in 16UC1 or 32FC1, found encoding 'rgb8'."
REASON = "no depth image: no depth image has been received"
LONG_RUN = RunWithoutDepth(REASON, begun_s=5.0, ended_s=5.5 + UNPLACED_S)
SHORT_RUN = replace(LONG_RUN, ended_s=5.0 + UNPLACED_S)
MISSING: dict[str, Any] = {"offers": (), "missing_s": DISCOVERY_S + 1}
NO_PLACE = "detections have no place in space"


GIVEN = subscription(SOURCE), subscription(INFO)


@pytest.mark.parametrize(
    ("depth", "message"),
    [
        pytest.param(depth_input(run=LONG_RUN, rejection=REJECTION), "detecting", id="not-needed"),
        pytest.param(
            depth_input(
                subscription(replace(SOURCE, **MISSING, sent_as="/a", remedy="type `this`")), GIVEN[1]
            ),
            "no publisher of depth images on /yolov5/depth/image_raw (but in another form on /a): "
            f"{NO_PLACE}; type `this`",
            id="images-in-another-form",
        ),
        pytest.param(
            depth_input(GIVEN[0], subscription(replace(INFO, **MISSING)), rejection=REJECTION),
            f"no publisher of its camera_info on /yolov5/depth/camera_info: {NO_PLACE}; start the depth "
            "camera, remap the topic or set depth to false",
            id="no-camera-info",
        ),
        pytest.param(
            depth_input(subscription(replace(SOURCE, offers=(), missing_s=DISCOVERY_S)), GIVEN[1]),
            "detecting",
            id="not-discovered-yet",
        ),
        pytest.param(
            depth_input(*GIVEN, rejection=REJECTION, run=LONG_RUN), f"{NO_PLACE}: {REJECTION}", id="rejected"
        ),
        pytest.param(depth_input(*GIVEN, run=LONG_RUN), f"{NO_PLACE}: {REASON}", id="unplaced"),
        pytest.param(depth_input(*GIVEN, run=SHORT_RUN), "detecting", id="unplaced-for-a-moment"),
    ],
)
def test_the_most_pressing_reason_without_a_place_is_told(depth: DepthInput, message: str) -> None:
    assert with_camera(depth=depth).of_node.message == message


def test_the_values_hold_every_count_and_the_configuration() -> None:
    counter = FrameCounter()
    for outcome in Outcome:
        counter.receive()
        counter.finish(outcome)
    counter.receive()
    counts = {"depth images received": 9, "unplaced: other size": 12}
    topic = replace(TOPIC, similar=("/a", "/b"))
    status = with_camera(topic, counter=counter, depth=depth_input(*GIVEN, counts=counts))
    values = status.of_node.values
    assert {values[f"frames {outcome.value}"] for outcome in Outcome} == {"1"}
    expected = {
        "frames received": str(len(Outcome) + 1),
        "frames pending": "1",
        "frames lost": "3",
        "frames overtaken": "7",
        "latency median ms": "21.0",
        "configuration": Settings().digest(),
        "image topic": "/yolov5/image_raw",
        "image publishers": "1",
        "other topics with images": "/a, /b",
        "tracker": "bytetrack",
        "depth topic": "/yolov5/depth/image_raw",
        "depth publishers": "1",
        "camera_info publishers": "1",
        "depth images received": "9",
        "unplaced: other size": "12",
    }
    assert expected.items() <= values.items()
    assert BLIND.of_node.values["best score in them"] == "0.61"
    assert "depth topic" not in with_camera(depth=depth_input()).of_node.values


def test_the_statuses_of_the_node_and_of_its_cameras_tell_the_same_of_cameras_that_go_on() -> None:
    asked = itertools.count(SILENCE_S + 1)

    class Silent(SimpleNamespace):
        @property
        def silent_s(self) -> float:
            return next(asked)

    received = Silent(**{name: value for name, value in INPUT.items() if name != "silent_s"})
    status = with_camera(name="front", input=received)
    (of_front,) = status.of_cameras
    assert status.of_node.message == f"front: {of_front.message}"
    assert status.of_node.level == of_front.level == DiagnosticStatus.WARN


def test_an_idle_camera_names_its_own_topics() -> None:
    (idle,) = with_camera(name="front", input=LAZY).of_cameras
    assert "no subscribers to ~/front/detections or ~/front/image" in idle.message


def test_a_reason_is_logged_when_it_begins_whatever_its_numbers(ros_domain: int) -> None:
    silent = [with_input(silent_s=silent_s) for silent_s in (5.0, 6.0, 17.0, 8.0, 9.0)]
    inactive = replace(GOOD, state="inactive")
    unnamed = replace(inactive, problem="no weights", namesakes="2 nodes")
    looks = [
        *((0.0, status) for status in (unnamed, GOOD, *silent[:3], GOOD, silent[0], BLIND, BLIND)),
        *((59.0, status) for status in (silent[1], GOOD)),
        (100.0, silent[2]),
        *((170.0, status) for status in (silent[3], inactive, silent[4], with_topic())),
    ]
    now_s, seen = 0.0, GOOD
    with closing(Observer("watched", domain=ros_domain)) as observer:
        logged: list[tuple[int, str]] = []
        observer.create_subscription(Log, "/rosout", lambda log: logged.append((log.level, log.msg)), 100)
        observer.wait_for(lambda: observer.count_subscribers("/rosout") == 1, "the subscription to the log")
        diagnostics = Diagnostics(observer, lambda: seen, period_s=1.0, clock=lambda: now_s)
        for now_s, seen in looks:  # noqa: B007 - the diagnostics look at both
            diagnostics.publish()
        observer.wait_for(lambda: "no publisher of images" in str(logged), "the last reason")
    warned, said = 30, 20
    words = [(warned, "2 nodes"), (warned, "for 5 s"), (said, "No detection in")]
    words += [(warned, "for 8 s"), (warned, "for 9 s")]
    for (level, text), (wanted, word) in zip(logged[:-1], words, strict=True):
        assert (level, word in text) == (wanted, True)
