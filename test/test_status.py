"""Why nothing comes out of an active node, and what is told of it."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from rclpy.qos import ReliabilityPolicy

from yolov5_lifecycle.frame_balance import FrameCounter, Outcome
from yolov5_lifecycle.rate import LatencySummary
from yolov5_lifecycle.ros.image_input import InputStatus
from yolov5_lifecycle.ros.status import SILENCE_S, SLOW_S, Status
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
    busy_s=0.02,
    recently_rejected="",
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
        pytest.param(dataclasses.replace(GOOD, state="inactive"), "inactive", id="state"),
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
