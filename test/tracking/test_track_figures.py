"""IDF1, HOTA and switches of small recordings whose figures can be computed by hand."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmark.tracking.figures import HOTA_IOUS, JudgedFrame, TrackCounts, track_counts

Places = Mapping[Any, float]
"""Identity -> x of a box of 10 x 10 pixels."""


def frame(truth: Places, tracks: Places) -> JudgedFrame:
    return JudgedFrame(
        list(truth),
        boxes(truth.values()),
        [str(name) for name in tracks],
        boxes(tracks.values()),
    )


def boxes(places: Iterable[float]) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    return np.array([(x, 0, x + 10, 10) for x in places], np.float32).reshape(-1, 4)


def counts(*frames: tuple[Places, Places]) -> TrackCounts:
    return track_counts([frame(truth, tracks) for truth, tracks in frames])


ONE = {1: 0.0}
TWO = {1: 0.0, 2: 100.0}


@pytest.mark.parametrize(
    ("frames", "idf1", "hota", "switches"),
    [
        pytest.param([], 1.0, 1.0, 0, id="nothing"),
        pytest.param([({}, {})] * 3, 1.0, 1.0, 0, id="no objects"),
        pytest.param([(TWO, {"a": 0.0, "b": 100.0})] * 4, 1.0, 1.0, 0, id="perfect"),
        pytest.param([(ONE, {})] * 4, 0.0, 0.0, 0, id="all missed"),
        pytest.param([({}, {"a": 0.0})] * 4, 0.0, 0.0, 0, id="all false"),
        pytest.param([(ONE, {"a": 50.0})] * 4, 0.0, 0.0, 0, id="elsewhere"),
        # Each of the two halves is identified with half of the frames and associated with half of the boxes.
        pytest.param(
            [(ONE, {"a": 0.0})] * 2 + [(ONE, {"b": 0.0})] * 2, 0.5, math.sqrt(0.5), 1, id="another id"
        ),
        pytest.param(
            [(TWO, {"a": 0.0, "b": 100.0})] * 2 + [(TWO, {"b": 0.0, "a": 100.0})] * 2,
            0.5,
            math.sqrt(1 / 3),
            2,
            id="ids exchanged",
        ),
        pytest.param([(ONE, {"a": 0.0}), (ONE, {})], 2 / 3, 0.5, 0, id="half missed"),
        pytest.param([(ONE, {"a": 0.0}), ({}, {"a": 0.0})], 2 / 3, 0.5, 0, id="stays too long"),
        pytest.param(
            [(ONE, {"a": 0.0}), (ONE, {}), (ONE, {"b": 0.0})], 0.4, math.sqrt(2 / 9), 1, id="another id later"
        ),
    ],
)
def test_the_figures_are_those_computed_by_hand(
    frames: Sequence[tuple[Places, Places]], idf1: float, hota: float, switches: int
) -> None:
    found = counts(*frames)
    assert found.idf1 == pytest.approx(idf1)
    assert found.hota == pytest.approx(hota)
    assert found.switches == switches


def test_hota_falls_with_the_overlap_and_idf1_asks_for_half() -> None:
    third = counts(*[(ONE, {"a": 5.0})] * 3)  # 5 of 15 pixels in common
    assert third.idf1 == 0
    assert third.hota == pytest.approx((HOTA_IOUS < 1 / 3).mean())
    half = counts(*[(ONE, {"a": 10 / 3})] * 3)
    assert half.idf1 == 1
    assert half.hota == pytest.approx((HOTA_IOUS < 0.501).mean())


def test_a_pair_continues_while_it_overlaps_although_another_fits_better() -> None:
    found = counts((ONE, {"a": 0.0}), (ONE, {"a": 3.0, "b": 0.0}))
    assert found.switches == 0


def test_counts_of_two_recordings_add_up() -> None:
    perfect, missed = counts((ONE, {"a": 0.0})), counts((ONE, {}))
    both = perfect + missed
    assert (both.truths, both.tracked, both.identified) == (2, 1, 1)
    assert both.idf1 == pytest.approx(2 / 3)
    assert both.hota == pytest.approx(math.sqrt(0.5))


names = st.permutations([0, 1, 2]).flatmap(lambda order: st.integers(0, 3).map(lambda count: order[:count]))
recordings = st.lists(st.tuples(names, names), max_size=6)


@settings(deadline=None, max_examples=40)
@given(recording=recordings)
def test_idf1_is_that_of_the_best_of_all_assignments(recording: list[tuple[list[int], list[int]]]) -> None:
    frames = [(_in_a_row(truths), _in_a_row(tracks)) for truths, tracks in recording]
    best = max(
        sum(place == tracks.get(order[truth]) for truths, tracks in frames for truth, place in truths.items())
        for order in itertools.permutations(range(3))
    )
    found = counts(*frames)
    assert found.identified == best
    assert 0 <= found.hota <= 1


def _in_a_row(names: list[int]) -> Places:
    return {name: 20.0 * place for place, name in enumerate(names)}
