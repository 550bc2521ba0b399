"""How well known identities are kept; `python -m benchmark.tracking` measures more."""

from __future__ import annotations

import itertools
import json
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from benchmark.tracking.__main__ import identity_goals, identity_table
from benchmark.tracking.camera_path import CAMERA_PATHS, DURATION_S, projected
from benchmark.tracking.cases import Case, counts_of, oracle_ids, own_ids, simulated_cases
from benchmark.tracking.figures import TrackCounts
from benchmark.tracking.film import Film
from benchmark.tracking.recording import START_S, recorded, simulated
from benchmark.tracking.rendering import rendered, shapes_detector
from benchmark.tracking.scenes import MIN_VISIBLE, SCENES, STILL_SCENES, crossings, occlusions, returns
from benchmark.tracking.times import camera_times_ms, update_times_ms

pytestmark = pytest.mark.long

CROWDED = ["crossings", "occlusions", "returns", "crowd"]


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    scenes = {name: scene for name, scene in STILL_SCENES.items() if name in CROWDED}
    return simulated_cases([0], scenes, with_film=False)


@pytest.mark.parametrize(
    ("rate_hz", "min_idf1", "min_hota", "max_switches"),
    [(5.0, 0.78, 0.6, 10), (10.0, 0.8, 0.62, 8), (30.0, 0.83, 0.64, 8)],
    ids=["5 Hz", "10 Hz", "30 Hz"],
)
def test_identities_are_kept_at_any_rate(
    cases: list[Case], rate_hz: float, min_idf1: float, min_hota: float, max_switches: int
) -> None:
    at_rate = [case for case in cases if case.rate_hz == rate_hz]
    assert [case.name for case in at_rate] == CROWDED
    counts = sum((counts_of(case.frames, own_ids(case.frames)) for case in at_rate), TrackCounts())
    assert counts.idf1 >= min_idf1
    assert counts.hota >= min_hota
    assert counts.switches <= max_switches


def test_identities_of_drawn_shapes_are_kept() -> None:
    rng = np.random.default_rng(0)
    with closing(shapes_detector()) as detector:
        frames = recorded(crossings(rng), 5.0, rng, rendered(detector, rng), Film(rng))
    counts = counts_of(frames, own_ids(frames))
    assert counts.idf1 >= 0.7
    assert counts.switches <= 4


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 30.0])
def test_a_recording_has_jitter_gaps_misses_and_false_detections(rate_hz: float) -> None:
    rng = np.random.default_rng(0)
    frames = recorded(SCENES["crowd"](rng), rate_hz, rng, simulated(rng))
    stamps_s = np.array([frame.stamp_s for frame in frames])
    steps_s = np.diff(stamps_s)
    assert steps_s.min() > 0
    assert steps_s.min() < 0.8 / rate_hz
    assert steps_s.max() > 1.5 / rate_hz
    assert stamps_s[0] >= START_S - 1
    assert stamps_s[-1] < START_S + DURATION_S + 1
    truths = sum(len(frame.truth_ids) for frame in frames)
    assert 0.7 * truths < sum(len(frame.detections) for frame in frames) < truths


def test_a_wall_hides_an_object_for_at_most_a_second() -> None:
    step_s = 0.02
    scene = occlusions(np.random.default_rng(0))
    visible = np.array(
        [scene.view(time_s).visible for time_s in np.arange(0, DURATION_S, step_s)]
    )  # (times, actors)
    for row in visible.T:
        inside = np.trim_zeros(row >= MIN_VISIBLE)
        hidden_s = [len(list(run)) * step_s for seen, run in itertools.groupby(inside.tolist()) if not seen]
        assert hidden_s
        assert max(hidden_s) <= 1.3  # a little more, until a quarter is seen again


def test_an_object_that_comes_back_into_the_image_is_another_one() -> None:
    rng = np.random.default_rng(0)
    scene = returns(rng)
    frames = recorded(scene, 10.0, rng, simulated(rng))
    assert len({name for frame in frames for name in frame.truth_ids}) > len(scene.actors)
    assert all(len(set(frame.truth_ids)) == len(frame.truth_ids) for frame in frames)


def test_the_oracle_gets_the_same_detections_and_its_ids_come_back(tmp_path: Path, cases: list[Case]) -> None:
    case = Case(cases[0].name, cases[0].rate_hz, cases[0].frames[:2])
    ids = [tuple(f"0-{row}" for row in range(len(frame.detections))) for frame in case.frames]
    (tmp_path / "answer").write_text(json.dumps([ids]))
    interpreter = tmp_path / "python"
    interpreter.write_text(f"#!/bin/sh\ncat > {tmp_path}/request\ncat {tmp_path}/answer\n")
    interpreter.chmod(0o755)
    assert oracle_ids(interpreter, [case]) == [ids]
    (request,) = json.loads((tmp_path / "request").read_text())
    assert [frame["stamp_s"] for frame in request["frames"]] == [frame.stamp_s for frame in case.frames]
    assert [len(frame["scores"]) for frame in request["frames"]] == [len(names) for names in ids]


def test_the_table_has_a_line_for_each_scene_and_rate_and_one_for_all(cases: list[Case]) -> None:
    counts = [TrackCounts(truths=1, tracked=1, identified=1) for _ in cases]
    lines = identity_table(cases, {"own": counts}).splitlines()[2:]
    assert len(lines) == len(cases) + 1
    assert lines[-1].split()[:2] == ["mean", "1.000"]


def test_the_time_of_each_update_is_measured() -> None:
    times_ms = update_times_ms(5, 8, np.random.default_rng(0))
    assert len(times_ms) == 8
    assert min(times_ms) > 0


def test_a_goal_is_missed_by_the_worst_scene_and_by_the_mean() -> None:
    cases = [Case(name, 10.0, ()) for name in ("street", "yaw")]

    def counts(*identified: int) -> list[TrackCounts]:
        return [TrackCounts(truths=100, tracked=100, identified=each) for each in identified]

    figures = {"own": counts(80, 90), "boxes": counts(81, 60), "oracle": counts(70, 70)}
    goals = {goal.what: goal for goal in identity_goals("simulated", cases, figures)}
    reached = {what.partition("simulated, ")[2]: goal.is_reached for what, goal in goals.items()}
    assert reached == {
        "own, mean": True,
        "own, worst scene": True,
        "boxes, mean": False,
        "boxes, worst scene": False,
        "camera still": False,
    }


def test_a_camera_on_a_robot_shows_what_stands_still_elsewhere() -> None:
    """Every path moves the image by some pixels within 2 s."""
    for name, path in CAMERA_PATHS.items():
        camera = path(np.random.default_rng(0))
        places = [
            projected(camera(time_s).plane(8.0), np.array(((100.0, 100.0),)))
            for time_s in np.arange(0, 2, 0.1)
        ]
        assert np.ptp(places, axis=0).max() > 3, name


def test_the_time_of_the_motion_of_a_camera_is_measured() -> None:
    times_ms = camera_times_ms((48, 64), 3, np.random.default_rng(0))
    assert len(times_ms) == 3
    assert min(times_ms) > 0
