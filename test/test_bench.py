"""The figures of `make bench`: measured in processes of their own, summed up without mistakes."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from support.colcon_workspace import REPOSITORY

from benchmark.bench import forward_goals
from benchmark.contender import contender
from benchmark.node import detector_node, image_file
from benchmark.report import Goal, goal_table, row, table, write_report
from benchmark.rivals import RIVALS, call_of
from benchmark.rounds import measure
from benchmark.task import Task
from yolov5_lifecycle.sources.scene import CLASS_NAMES

pytestmark = pytest.mark.long

WEIGHTS = REPOSITORY / "weights" / "shapes.safetensors"
IMAGE_HW = (96, 128)
EAGER = Task("rivals", "eager torch", str(WEIGHTS), IMAGE_HW)
DETECTOR = Task("work", "runtime torch", str(WEIGHTS), IMAGE_HW)
MEDIANS_MS = {
    "runtime auto": 10.0,
    "detector": 11.0,
    "eager torch": 30.0,
    "ONNX Runtime": 12.0,
    "ONNX Runtime, no spinning": 11.0,
    "OpenVINO": 9.5,
}


def test_contenders_measure_in_turns_beside_every_load(tmp_path: Path) -> None:
    taken_ms, peaks_mb = measure([EAGER, DETECTOR], loads=(0, 1), turns=2, cache=tmp_path)
    assert {key: len(times_ms) for key, times_ms in taken_ms.items()} == {
        (task, busy): 6 for task in (EAGER, DETECTOR) for busy in (0, 1)
    }
    assert min(time_ms for times_ms in taken_ms.values() for time_ms in times_ms) > 0
    assert peaks_mb.keys() == {EAGER, DETECTOR}
    assert min(peaks_mb.values()) > 50


def test_a_rival_that_does_not_run_is_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    unknown = dataclasses.replace(EAGER, name="abacus")
    taken_ms, _ = measure([unknown, EAGER], loads=(0,), turns=1, cache=tmp_path)
    assert taken_ms.keys() == {(EAGER, 0)}
    assert "left out: 'abacus' failed" in capsys.readouterr().err


@pytest.mark.usefixtures("_environment")
def test_the_node_is_watched_while_a_camera_runs(tmp_path: Path) -> None:
    image = image_file(IMAGE_HW, tmp_path)
    with detector_node(WEIGHTS, tmp_path) as node:
        assert node.activate_s() > 0
        passage = node.watch(image, rate_hz=10.0, frames=5)
        assert node.peak_resident_mb > 50
    assert len(passage.latencies_ms) >= 5
    assert min(passage.latencies_ms) > 0
    assert passage.rate_hz > 0
    assert passage.cpu_ms_per_frame > 0


@pytest.mark.parametrize("name", RIVALS)
def test_a_rival_predicts_what_the_network_does(name: str) -> None:
    if name == "OpenCV DNN" and cv2.__version__ < "5":
        pytest.skip("OpenCV 4.6 cannot run the network")
    found, expected = (rows_of(call_of(task)()) for task in (dataclasses.replace(EAGER, name=name), EAGER))
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.01)


def rows_of(answer: Any) -> NDArray[np.float32]:
    """The rows in what a rival gives: them, or a collection that has them first."""
    rows = answer if isinstance(answer, (np.ndarray, torch.Tensor)) else answer[0]
    return np.asarray(rows).reshape(-1, 5 + len(CLASS_NAMES))


@pytest.mark.parametrize(
    ("changed", "missed"),
    [
        pytest.param({}, [], id="all reached"),
        pytest.param({"OpenVINO": 9.0}, ["forward / best bare rival"], id="a faster rival"),
        pytest.param({"eager torch": 20.0}, ["eager torch / forward"], id="fast usual way"),
        pytest.param({"detector": 12.5}, ["detector / forward"], id="a slow detector"),
    ],
)
def test_the_goals_of_forwards_compare_with_the_best_rival_and_the_usual_way(
    changed: dict[str, float], missed: list[str]
) -> None:
    goals = forward_goals(MEDIANS_MS | changed, busy=0)
    assert [goal.what for goal in goals if not goal.is_reached] == missed


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
