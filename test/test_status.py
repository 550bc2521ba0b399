"""Why nothing comes out of an active node, and what is told of it."""

from __future__ import annotations

import dataclasses
from contextlib import closing
from typing import Any

import pytest
from rcl_interfaces.msg import Log
from rclpy.qos import ReliabilityPolicy

from yolov5_lifecycle.empty_frames import EmptyFrames, EmptyRun
from yolov5_lifecycle.frame_balance import FrameCounter, Outcome
from yolov5_lifecycle.rate import LatencySummary
from yolov5_lifecycle.ros.diagnostics import Diagnostics
from yolov5_lifecycle.ros.image_input import InputStatus
from yolov5_lifecycle.ros.observer import Observer
from yolov5_lifecycle.ros.status import EMPTY_S, SILENCE_S, SLOW_S, Status
from yolov5_lifecycle.settings import Settings

GOOD_INPUT = InputStatus(
    topic="/yolov5/image_raw",
    reliability=ReliabilityPolicy.BEST_EFFORT,
    publishers=1,
    best_effort_publishers=1,
    silent_s=0.1,
    received_lately=30,
    lost_lately=1,
    lost=3,
)
_IDLE = "idle (lazy): nobody listens to ~/detections or ~/image, so no images are taken"
GOOD = Status(
    state="active",
    problem="",
    balance=FrameCounter().balance(),
    settings=Settings(),
    model=None,
    input=GOOD_INPUT,
    latency=LatencySummary(29.9, 21.0, 30.5),
    empty=EmptyRun(0.9),
    busy_s=0.02,
    recently_rejected="",
)
BLIND = dataclasses.replace(
    GOOD, empty=EmptyRun(0.9, frames=152, begun_s=5.0, ended_s=6.0 + EMPTY_S, best_missed=0.614)
)


def _with_input(**changes: Any) -> Status:
    return dataclasses.replace(GOOD, input=dataclasses.replace(GOOD_INPUT, **changes))


@pytest.mark.parametrize(
    ("status", "hint"),
    [
        pytest.param(GOOD, "", id="all-is-well"),
        pytest.param(dataclasses.replace(GOOD, input=None), "", id="lazy-is-no-trouble"),
        pytest.param(_with_input(lost_lately=10), "10 of 40 images were lost", id="losses"),
        pytest.param(
            _with_input(publishers=0), "nobody publishes images on /yolov5/image_raw", id="no-camera"
        ),
        pytest.param(
            _with_input(reliability=ReliabilityPolicy.RELIABLE), "does not match", id="incompatible-quality"
        ),
        pytest.param(
            _with_input(silent_s=SILENCE_S + 5), "no image on /yolov5/image_raw for 7 s", id="silence"
        ),
        pytest.param(
            dataclasses.replace(GOOD, busy_s=SLOW_S + 1), "at one image for more than 2 s", id="hanging"
        ),
        pytest.param(
            dataclasses.replace(GOOD, recently_rejected="Encoding 'x' is not supported"),
            "images are rejected: Encoding 'x'",
            id="rejected",
        ),
        pytest.param(BLIND, "", id="nothing-to-see-is-no-trouble"),
        pytest.param(dataclasses.replace(GOOD, state="inactive", input=None), "", id="not-active"),
    ],
)
def test_an_active_node_hints_at_what_is_missing(status: Status, hint: str) -> None:
    assert (hint in status.hint) if hint else (status.hint == "")


@pytest.mark.parametrize(
    ("status", "message"),
    [
        pytest.param(GOOD, "detecting", id="detecting"),
        pytest.param(dataclasses.replace(GOOD, input=None), _IDLE, id="lazy"),
        pytest.param(
            BLIND,
            "nothing scored above confidence_threshold 0.9 in the last 152 frames, the best 0.61: if there "
            "was something, lower it, or empty classes",
            id="below-threshold",
        ),
        pytest.param(
            dataclasses.replace(BLIND, recently_rejected="too small"),
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
    ],
)
def test_the_message_is_the_most_pressing_thing(status: Status, message: str) -> None:
    assert status.message == message


def test_the_values_hold_every_count_and_the_configuration() -> None:
    counter = FrameCounter()
    for outcome in Outcome:
        counter.receive()
        counter.finish(outcome)
    counter.receive()
    values = dataclasses.replace(GOOD, balance=counter.balance()).values()
    assert {values[f"frames {outcome.value}"] for outcome in Outcome} == {"1"}
    assert (values["frames received"], values["frames pending"]) == (str(len(Outcome) + 1), "1")
    assert values["frames lost"] == "3"
    assert values["configuration"] == Settings().digest()
    assert values["latency median ms"] == "21.0"
    assert BLIND.values()["best score in them"] == "0.61"


def test_scores_that_are_mere_noise_are_not_told() -> None:
    assert BLIND.empty is not None
    noise = dataclasses.replace(BLIND, empty=dataclasses.replace(BLIND.empty, best_missed=0.0))
    assert "152 frames, nothing even above 0.05: if there was something" in noise.remark


def test_empty_frames_are_counted_until_something_is_found() -> None:
    frames = EmptyFrames(0.5)
    assert (frames.run.frames, frames.run.duration_s) == (0, 0.0)
    for now_s, best_missed in ((3.0, 0.1), (4.0, 0.4), (6.0, 0.0)):
        frames.add(now_s, 0, best_missed)
    assert (frames.run.frames, frames.run.duration_s, frames.run.threshold) == (3, 3.0, 0.5)
    assert frames.run.best_missed == 0.4
    frames.add(7.0, 1, 0.0)
    assert frames.run == EmptyRun(0.5)


def test_the_log_says_a_reason_once_a_minute_whatever_its_numbers(ros_domain: int) -> None:
    silent = [_with_input(silent_s=silent_s) for silent_s in (5.0, 6.0, 17.0, 8.0, 9.0)]
    inactive = dataclasses.replace(GOOD, state="inactive")
    looks = [
        *((0.0, status) for status in (GOOD, *silent[:3], GOOD, silent[0], BLIND, BLIND, silent[1])),
        *((70.0, status) for status in (silent[2], GOOD, silent[3], inactive, silent[4])),
    ]
    now_s, last = 0.0, _with_input(publishers=0)
    with closing(Observer("watched", domain=ros_domain)) as observer:
        logged: list[str] = []
        observer.create_subscription(Log, "/rosout", lambda log: logged.append(log.msg), 100)
        observer.wait_for(lambda: observer.count_subscribers("/rosout") == 1, "the subscription to the log")
        seen = last
        diagnostics = Diagnostics(observer, lambda: seen, clock=lambda: now_s)
        for now_s, seen in [*looks, (70.0, last)]:  # noqa: B007 - the diagnostics look at both
            diagnostics.publish()
        observer.wait_for(lambda: any("nobody publishes" in text for text in logged), "the last reason")
    words = ("for 5 s", "nothing scored", "for 8 s", "for 9 s", "nobody publishes")
    assert len(logged) == len(words)
    assert all(word in text for word, text in zip(words, logged, strict=True))
