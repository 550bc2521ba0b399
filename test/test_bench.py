"""The figures of `make bench`: measured in processes of their own, summed up without mistakes."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from colcon_workspace import REPOSITORY

from benchmark.contender import contender
from benchmark.report import Goal, goal_table, row, table, write_report
from benchmark.task import Task

WEIGHTS = REPOSITORY / "weights" / "shapes.safetensors"
EAGER = Task("rivals", "eager torch", str(WEIGHTS), (96, 128))
DETECTOR = Task("work", "runtime torch", str(WEIGHTS), (96, 128))


@pytest.mark.parametrize("task", [EAGER, DETECTOR], ids=lambda task: task.name)
def test_a_contender_measures_as_many_rounds_as_asked(task: Task) -> None:
    with contender(task, os.environ) as each:
        times_ms = each.measure(4)
        assert each.peak_resident_mb > 50
    assert len(times_ms) == 4
    assert all(0 < time_ms < 10_000 for time_ms in times_ms)
    assert each.process.returncode == -signal.SIGKILL


def test_a_contender_that_fails_is_named() -> None:
    absent = Task("work", "runtime abacus", str(WEIGHTS), (96, 128))
    with pytest.raises(RuntimeError, match="'runtime abacus' failed"), contender(absent, os.environ):
        pass


def test_a_row_has_median_p95_and_the_spread_of_the_quartiles() -> None:
    figures = row("forward", "torch", 1, [*range(1, 100), 1000])
    assert (figures.median, figures.p95) == (50.5, 95)
    assert figures.spread == pytest.approx((75 - 26) / 50.5)


def test_ratios_are_to_the_best_of_the_same_load() -> None:
    rows = [row("forward", "a", 0, [10]), row("forward", "b", 0, [15]), row("forward", "c", 1, [30])]
    ratios = [line.split()[-2] for line in table(rows).splitlines()[2:]]
    assert ratios == ["1.00", "1.50", "1.00"]


@pytest.mark.parametrize(
    ("value", "at_most", "is_reached"),
    [
        pytest.param(1.1, True, True, id="at the upper bound"),
        pytest.param(1.2, True, False, id="above the upper bound"),
        pytest.param(1.1, False, True, id="at the lower bound"),
        pytest.param(1.0, False, False, id="below the lower bound"),
    ],
)
def test_a_goal_is_reached_or_missed(value: float, at_most: bool, is_reached: bool) -> None:
    goal = Goal("ratio", 0, value, at_most, 1.1)
    assert goal.is_reached == is_reached
    assert goal_table([goal]).startswith("reached" if is_reached else "MISSED")


def test_the_report_has_what_was_measured_and_where(tmp_path: Path) -> None:
    path = tmp_path / "bench" / "report.json"
    goal = Goal("ratio", 0, 2.0, True, 1.1)
    write_report(path, {"busy": 1}, [row("forward", "a", 0, [10.0])], [goal])
    report = json.loads(path.read_text())
    assert report["rows"][0]["median"] == 10.0
    assert report["goals"][0]["is_reached"] is False
    assert report["options"] == {"busy": "1"}
    assert "torch" in report["versions"]
