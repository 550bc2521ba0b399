"""The figures of `make bench` for collecting images: what is compared with a detector that collects none."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY

from benchmark.camera_fleet import Arrival, Passage
from benchmark.collecting import NOTHING_KEPT, OFF, ONE_A_SECOND, figures, passage
from benchmark.node import image_file
from yolov5_lifecycle.collecting.collected_files import read_frame_list

pytestmark = pytest.mark.long

WEIGHTS = REPOSITORY / "weights" / "shapes.safetensors"


def passed(latency_ms: int, cpu_s: float) -> Passage:
    arrivals = tuple(Arrival("front", 0, latency_ms * 1_000_000) for _ in range(3))
    return Passage(arrivals, 10.0, cpu_s, 300.0, 300.0)


def test_each_round_is_compared_with_the_same_round_without_collecting() -> None:
    rows, goals = figures(
        {
            OFF: [passed(10, 4.0), passed(20, 8.0), passed(10, 4.0)],
            NOTHING_KEPT: [passed(10, 4.1), passed(20, 8.1), passed(30, 9.0)],
            ONE_A_SECOND: [passed(11, 5.5), passed(22, 9.5), passed(11, 5.5)],
        }
    )
    assert [goal.value for goal in goals] == pytest.approx([1.0, 1.0, 15.0, 1.1])
    assert [goal.is_reached for goal in goals] == [True, True, False, False]
    assert [each.median for each in rows if each.what == "CPU"] == pytest.approx([40, 81, 55])


@pytest.mark.usefixtures("_environment")
@pytest.mark.parametrize(("way", "kept"), [(OFF, 0), (NOTHING_KEPT, 1), (ONE_A_SECOND, 2)])
def test_a_detector_collects_as_the_figures_say(way: str, kept: int, tmp_path: Path) -> None:
    options = argparse.Namespace(rate=10.0, seconds=2.5)
    measured = passage(way, WEIGHTS, image_file((96, 128), tmp_path), tmp_path, options)
    assert measured.cpu_s > 0
    found = len(read_frame_list(tmp_path / "collected").frames) if way != OFF else 0
    assert found == kept if way != ONE_A_SECOND else found >= kept
