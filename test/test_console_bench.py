"""What the benchmark of the console measures, and which goals it compares it with."""

from __future__ import annotations

import asyncio

import pytest

from benchmark.console import Viewing, goals, robot, viewing

pytestmark = pytest.mark.long


def seen(age_ms: float, cpu_s: float) -> Viewing:
    return Viewing([age_ms] * 100, [20.0, 30.0], cpu_s, 10.0)


def test_the_age_is_compared_with_the_latency_and_the_cost_with_that_of_one_viewer() -> None:
    age, cost = goals({1: [seen(125.0, 1.0)], 4: [seen(1000.0, 1.3)]})
    assert (age.value, age.is_reached) == (100.0, True)
    assert cost.value == pytest.approx(1.3)
    assert not goals({1: [seen(125.0, 1.0)], 4: [seen(1.0, 1.31)]})[1].is_reached
    age, cost = goals({1: [seen(126.0, 1.0)], 4: [seen(126.0, 1.4)]})
    assert not age.is_reached
    assert not cost.is_reached


@pytest.mark.usefixtures("_environment")
def test_two_viewers_see_images() -> None:
    with robot(15.0) as console:
        found = asyncio.run(viewing(console, 2, 2.0))
    assert found.ages_ms
    assert min(found.ages_ms) > 0
    assert found.cpu_s >= 0
