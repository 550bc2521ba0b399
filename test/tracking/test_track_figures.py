"""IDF1 and switches of small recordings whose figures can be computed by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmark.tracking.cases import Case, counts_of, own_ids, simulated_cases
from benchmark.tracking.figures import JudgedFrame, TrackCounts, track_counts
from benchmark.tracking.scenes import STILL_SCENES

Places = Mapping[Any, float]
"""Identity -> x of a box of 10 x 10 pixels."""


def boxes(places: Places) -> NDArray[np.float32]:
    return np.array([(x, 0, x + 10, 10) for x in places.values()], np.float32).reshape(-1, 4)


def counts(*frames: tuple[Places, Places]) -> TrackCounts:
    return track_counts(
        [
            JudgedFrame(list(truth), boxes(truth), list(map(str, tracks)), boxes(tracks))
            for truth, tracks in frames
        ]
    )


ONE = {1: 0.0}
TWO = {1: 0.0, 2: 100.0}


@pytest.mark.parametrize(
    ("frames", "idf1", "switches"),
    [
        pytest.param([], 1.0, 0, id="nothing"),
        pytest.param([(TWO, {"a": 0.0, "b": 100.0})] * 4, 1.0, 0, id="perfect"),
        pytest.param([(ONE, {})] * 4, 0.0, 0, id="all missed"),
        pytest.param([({}, {"a": 0.0})] * 4, 0.0, 0, id="all false"),
        pytest.param([(ONE, {"a": 5.0})] * 4, 0.0, 0, id="a third in common"),
        pytest.param([(ONE, {"a": 10 / 3})] * 4, 1.0, 0, id="half in common"),
        # "a" was on both for most of its frames; "b" leaves it to the second, which has no other.
        pytest.param(
            [(TWO, {"a": 0.0})] * 3 + [(TWO, {"a": 100.0, "b": 0.0})] * 2, 8 / 17, 1, id="best assignment"
        ),
        # Each of the two halves is identified with half of the frames.
        pytest.param([(ONE, {"a": 0.0})] * 2 + [(ONE, {"b": 0.0})] * 2, 0.5, 1, id="another id"),
        pytest.param(
            [(TWO, {"a": 0.0, "b": 100.0})] * 2 + [(TWO, {"b": 0.0, "a": 100.0})] * 2,
            0.5,
            2,
            id="ids exchanged",
        ),
        pytest.param([(ONE, {"a": 0.0}), (ONE, {})], 2 / 3, 0, id="half missed"),
        pytest.param([(ONE, {"a": 0.0}), (ONE, {}), (ONE, {"b": 0.0})], 0.4, 1, id="another id later"),
    ],
)
def test_the_figures_are_those_computed_by_hand(
    frames: Sequence[tuple[Places, Places]], idf1: float, switches: int
) -> None:
    found = counts(*frames)
    assert found.idf1 == pytest.approx(idf1)
    assert found.switches == switches


pytestmark = pytest.mark.long

CROWDED = ["crossings", "occlusions", "returns", "crowd"]


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    scenes = {name: scene for name, scene in STILL_SCENES.items() if name in CROWDED}
    return simulated_cases([0], scenes, with_film=False)


@pytest.mark.parametrize(
    ("rate_hz", "min_idf1", "max_switches"),
    [(5.0, 0.78, 10), (10.0, 0.8, 8), (30.0, 0.83, 8)],
    ids=["5 Hz", "10 Hz", "30 Hz"],
)
def test_identities_are_kept_at_any_rate(
    cases: list[Case], rate_hz: float, min_idf1: float, max_switches: int
) -> None:
    at_rate = [case for case in cases if case.rate_hz == rate_hz]
    assert [case.name for case in at_rate] == CROWDED
    counts = sum((counts_of(case.frames, own_ids(case.frames)) for case in at_rate), TrackCounts())
    assert counts.idf1 >= min_idf1
    assert counts.switches <= max_switches
