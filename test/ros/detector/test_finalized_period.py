"""A finalized node stays for a while, then its process may end."""

from __future__ import annotations

import pytest

from yolov5_lifecycle.ros.detector.command import FINALIZED_S, FinalizedPeriod


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_it_lasts_for_its_duration_from_the_first_look() -> None:
    clock, said = Clock(), list[str]()
    period = FinalizedPeriod(announce=said.append, duration_s=3.0, clock=clock)
    assert not period.is_over("active")
    clock.now_s += 60
    assert not period.is_over("finalized")
    clock.now_s += 2.9
    assert not period.is_over("finalized")
    clock.now_s += 0.1
    assert period.is_over("finalized")
    assert said == ["finalized: everything is released, the process ends in 3 s"]


@pytest.mark.parametrize("state", ["unconfigured", "inactive", "active", "shuttingdown", ""])
def test_no_other_state_ends(state: str) -> None:
    clock = Clock()
    period = FinalizedPeriod(announce=str, duration_s=0.0, clock=clock)
    assert not period.is_over(state)
    clock.now_s += 1e9
    assert not period.is_over(state)


def test_nav2_has_the_time_to_ask() -> None:
    assert FINALIZED_S >= 2 * 2.0, "its manager waits 2 s for the answer of get_state"
