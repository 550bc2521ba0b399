"""Why an active node publishes nothing, and how it is reported."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from typing import Any

import pytest
from rcl_interfaces.msg import Log
from rclpy.qos import ReliabilityPolicy
from support.good_status import GOOD, GOOD_CAMERA, GOOD_INPUT, LARGE, OF_CAMERAS

from yolov5_lifecycle.ros.detector.camera_status import EMPTY_S, SILENCE_S, SLOW_S
from yolov5_lifecycle.ros.detector.diagnostics import Diagnostics, Status
from yolov5_lifecycle.ros.detector.image_topic import DISCOVERY_S, TopicStatus
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.streaming.frame_statistics import EmptyRun, FrameCounter, Outcome

NO_CAMERA = TopicStatus(name="/yolov5/image_raw", missing_s=DISCOVERY_S + 1)
SMALL = 230_400
_IDLE = "idle (lazy): no subscribers to ~/detections or ~/image, so no images are received"


def _with_camera(**changes: Any) -> Status:
    return dataclasses.replace(GOOD, cameras=(dataclasses.replace(GOOD_CAMERA, **changes),))


BLIND_RUN = EmptyRun(0.9, frames=152, begun_s=5.0, ended_s=6.0 + EMPTY_S, best_missed=0.614)
BLIND = _with_camera(empty=BLIND_RUN)


def _with_topic(topic: TopicStatus = NO_CAMERA, **changes: Any) -> Status:
    return _with_camera(topic=dataclasses.replace(topic, **changes))


def _with_losses(received: int, lost: int, max_bytes: int = LARGE) -> Status:
    return _with_input(window_s=4.2, received=received, lost=lost, max_bytes=max_bytes)


def _with_input(**changes: Any) -> Status:
    return _with_camera(input=dataclasses.replace(GOOD_INPUT, **changes))


@pytest.mark.parametrize(
    ("status", "hint"),
    [
        pytest.param(GOOD, "", id="all-is-well"),
        pytest.param(_with_camera(input=None), "", id="lazy-is-no-trouble"),
        pytest.param(
            _with_losses(30, 10), "10 of 40 images were lost between the camera and this node", id="losses"
        ),
        pytest.param(_with_losses(30, 10), "in the last 4 s", id="losses-say-how-long"),
        pytest.param(_with_losses(30, 10), "the camera with the profile config/shm.xml", id="large-losses"),
        pytest.param(_with_losses(30, 10, SMALL), "overloaded. Lower the camera's rate", id="small-losses"),
        pytest.param(_with_losses(3, 4), "", id="too-few-images-to-judge"),
        pytest.param(_with_topic(), "no publisher of images on /yolov5/image_raw", id="no-camera"),
        pytest.param(_with_topic(missing_s=DISCOVERY_S), "", id="camera-not-discovered-yet"),
        pytest.param(
            _with_topic(similar=("/camera/image_raw",)),
            "Images are published on /camera/image_raw: did you mean that?",
            id="another-topic",
        ),
        pytest.param(
            _with_topic(sent_as="/a/compressed", remedy="type `this`", similar=("/a/compressed", "/b")),
            "/yolov5/image_raw. They are published in another form, on /a/compressed: type `this`",
            id="another-form",
        ),
        pytest.param(
            _with_topic(similar=("/a", "/b"), remedy="type `this`"),
            "Images are published on /a and /b: did you mean that? For /a, type `this`",
            id="other-topics-with-remedy",
        ),
        pytest.param(
            _with_topic(other_types=("std_msgs/msg/String",)),
            "on /yolov5/image_raw (but std_msgs/msg/String)",
            id="another-type",
        ),
        pytest.param(
            _with_input(reliability=ReliabilityPolicy.RELIABLE), "does not match", id="incompatible-quality"
        ),
        pytest.param(
            _with_input(silent_s=SILENCE_S + 5), "no image on /yolov5/image_raw for 7 s", id="silence"
        ),
        pytest.param(
            _with_camera(busy_s=SLOW_S + 1),
            "inference of one image takes more than 2 s",
            id="hanging",
        ),
        pytest.param(
            _with_camera(recent_failure="images are rejected: Encoding 'x' is not supported"),
            "images are rejected: Encoding 'x'",
            id="rejected",
        ),
        pytest.param(BLIND, "", id="nothing-to-see-is-no-trouble"),
        pytest.param(dataclasses.replace(GOOD, state="inactive"), "", id="not-active"),
    ],
)
def test_an_active_node_hints_at_what_is_missing(status: Status, hint: str) -> None:
    assert (hint in status.of_node.hint) if hint else (status.of_node.hint == "")


@pytest.mark.parametrize(
    ("status", "message"),
    [
        pytest.param(GOOD, "detecting", id="detecting"),
        pytest.param(_with_camera(input=None), _IDLE, id="lazy"),
        pytest.param(
            _with_camera(topic=dataclasses.replace(NO_CAMERA, similar=("/front/image_raw",)), input=None),
            f"{_IDLE}; no publisher of images on /yolov5/image_raw: start the camera or remap the topic. "
            "Images are published on /front/image_raw: did you mean that?",
            id="lazy-and-remapped-wrongly",
        ),
        pytest.param(
            _with_topic(missing_s=0.5),
            "waiting for a publisher of images on /yolov5/image_raw",
            id="discovery",
        ),
        pytest.param(
            BLIND,
            "No detection in 152 frames: best score 0.61, confidence_threshold 0.9. Lower the threshold, or "
            "clear classes",
            id="below-threshold",
        ),
        pytest.param(
            _with_camera(empty=dataclasses.replace(BLIND_RUN, has_class_thresholds=True)),
            "No detection in 152 frames: best score 0.61, confidence_threshold 0.9 and class_thresholds. "
            "Lower the thresholds, or clear classes",
            id="below-thresholds-of-classes",
        ),
        pytest.param(
            _with_camera(empty=dataclasses.replace(BLIND_RUN, best_missed=0.0)),
            "No detection in 152 frames: no score above 0.05. Check the images, image_size and weights, or "
            "clear classes",
            id="nothing-above-noise",
        ),
        pytest.param(
            _with_camera(empty=dataclasses.replace(BLIND_RUN, best_filtered=0.956)),
            "Objects are found (best 0.96), but all are filtered out: check regions, ignore_regions, "
            "min_box_size, max_box_size",
            id="all-filtered",
        ),
        pytest.param(
            _with_camera(segments=False),
            "~/masks has a subscriber, but the loaded model does not segment: load a segmentation model, "
            "such as yolov5n-seg.pt, with weights",
            id="masks-of-a-model-without",
        ),
        pytest.param(_with_camera(segments=False, mask_subscribers=0), "detecting", id="no-masks-wanted"),
        pytest.param(
            _with_camera(segments=False, recent_failure="images are rejected: too small"),
            "images are rejected: too small",
            id="trouble-before-masks",
        ),
        pytest.param(
            _with_camera(empty=BLIND_RUN, recent_failure="images are rejected: too small"),
            "images are rejected: too small",
            id="trouble-before-remark",
        ),
        pytest.param(
            dataclasses.replace(GOOD, state="unconfigured"),
            "unconfigured: configure and activate the node to detect",
            id="unconfigured",
        ),
        pytest.param(
            dataclasses.replace(GOOD, state="inactive"),
            "inactive: activate the node to detect",
            id="inactive",
        ),
        pytest.param(dataclasses.replace(GOOD, state="finalized"), "finalized", id="any-other-state"),
        pytest.param(dataclasses.replace(GOOD, problem="no weights"), "no weights", id="problem-first"),
        pytest.param(
            dataclasses.replace(_with_topic(), namesakes="2 nodes"), "2 nodes", id="namesakes-before-images"
        ),
        pytest.param(
            dataclasses.replace(GOOD, state="inactive", cameras=(), namesakes="2 nodes"),
            "2 nodes",
            id="namesakes-in-every-state",
        ),
        pytest.param(
            dataclasses.replace(OF_CAMERAS, state="inactive", namesakes="2 nodes"),
            "2 nodes",
            id="namesakes-of-a-node-with-cameras",
        ),
    ],
)
def test_the_message_is_the_most_pressing_thing(status: Status, message: str) -> None:
    assert status.of_node.message == message


def test_the_values_hold_every_count_and_the_configuration() -> None:
    counter = FrameCounter()
    for outcome in Outcome:
        counter.receive()
        counter.finish(outcome)
    counter.receive()
    values = _with_camera(balance=counter.balance()).of_node.values
    assert {values[f"frames {outcome.value}"] for outcome in Outcome} == {"1"}
    assert (values["frames received"], values["frames pending"]) == (str(len(Outcome) + 1), "1")
    assert (values["frames lost"], values["frames overtaken"]) == ("3", "7")
    assert values["configuration"] == Settings().digest()
    assert values["latency median ms"] == "21.0"
    assert BLIND.of_node.values["best score in them"] == "0.61"


def test_scores_that_are_mere_noise_are_not_reported() -> None:
    noise = _with_camera(empty=dataclasses.replace(BLIND_RUN, best_missed=0.0))
    assert "152 frames: no score above 0.05. Check the images" in noise.of_node.remark


def test_a_reason_is_logged_once_a_minute_whatever_its_numbers(ros_domain: int) -> None:
    silent = [_with_input(silent_s=silent_s) for silent_s in (5.0, 6.0, 17.0, 8.0, 9.0)]
    inactive = dataclasses.replace(GOOD, state="inactive")
    looks = [
        *((0.0, status) for status in (GOOD, *silent[:3], GOOD, silent[0], BLIND, BLIND, silent[1])),
        *((70.0, status) for status in (silent[2], GOOD, silent[3], inactive, silent[4])),
    ]
    now_s, last = 0.0, _with_topic()
    with closing(Observer("watched", domain=ros_domain)) as observer:
        logged: list[str] = []
        observer.create_subscription(Log, "/rosout", lambda log: logged.append(log.msg), 100)
        observer.wait_for(lambda: observer.count_subscribers("/rosout") == 1, "the subscription to the log")
        seen = last
        diagnostics = Diagnostics(observer, lambda: seen, period_s=1.0, clock=lambda: now_s)
        for now_s, seen in [*looks, (70.0, last)]:  # noqa: B007 - the diagnostics look at both
            diagnostics.publish()
        observer.wait_for(lambda: any("no publisher of images" in text for text in logged), "the last reason")
    words = ("for 5 s", "No detection in", "for 8 s", "for 9 s", "no publisher of images")
    assert len(logged) == len(words)
    assert all(word in text for word, text in zip(words, logged, strict=True))


def test_the_digest_of_a_configuration_is_computed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    computed: list[Settings] = []

    def digest(settings: Settings) -> str:
        computed.append(settings)
        return "0" * 12

    monkeypatch.setattr(Settings, "digest", digest)
    status = dataclasses.replace(GOOD, settings=Settings(max_rate=7.0))
    for _ in range(3):
        assert status.of_node.values["configuration"] == "0" * 12
    assert len(computed) == 1
