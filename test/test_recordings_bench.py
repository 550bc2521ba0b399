"""What the benchmark of many recordings measures, and which ratios it compares with its goals."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmark.recordings import ONE, ONE_CORE, SINGLE, TWO, goals, measured_s, record_scene
from yolov5_lifecycle.offline.recording import open_recording

pytestmark = pytest.mark.long


def test_the_recording_has_the_images_that_are_asked_for(tmp_path: Path) -> None:
    record_scene(tmp_path / "drive", 23)
    with open_recording(tmp_path / "drive") as recording:
        images = list(recording.images(recording.image_topic()))
    assert [image.load().size_hw for image in images] == [(480, 640)] * 23


def test_every_call_is_measured_in_turns_and_the_first_turn_is_not_counted() -> None:
    made: list[str] = []
    taken_s = measured_s({name: lambda name=name: made.append(name) for name in "ab"}, 2)  # type: ignore[misc]
    assert made == list("ababab")
    assert {name: len(times_s) for name, times_s in taken_s.items()} == {"a": 2, "b": 2}


def test_the_goals_are_medians_of_the_ratios_of_each_round() -> None:
    taken_s = {SINGLE: [10.0, 20.0, 10.0], ONE: [10.4, 20.8, 99.0], ONE_CORE: [16.0] * 3, TWO: [10.0] * 3}
    overhead, gain, threads = goals(taken_s)
    assert (round(overhead.value, 6), overhead.is_reached) == (1.04, True)
    assert (gain.value, gain.is_reached) == (1.6, True)
    assert (round(threads.value, 6), threads.is_reached) == (2.08, True)
