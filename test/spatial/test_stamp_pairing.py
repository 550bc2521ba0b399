"""A colour image gets the depth image of its time, or a reason."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from yolov5_lifecycle.spatial.stamp_pairing import CAPACITY, DepthPairing, Unpaired

MS = 1_000_000
FRAME_MS = 33
SLOP_S = 0.02


def pairing(*stamps_ms: int, slop_s: float = SLOP_S) -> DepthPairing[str]:
    """A pairing with one depth image per stamp, named after it."""
    depths = DepthPairing[str](slop_s)
    for stamp_ms in stamps_ms:
        depths.add(stamp_ms * MS, f"at {stamp_ms}")
    return depths


@pytest.mark.parametrize(
    ("received_ms", "colour_ms", "expected"),
    [
        pytest.param([80], 100, "at 80", id="older by the slop"),
        pytest.param([120], 100, "at 120", id="newer by the slop"),
        pytest.param([90, 100, 110], 100, "at 100", id="nearest of three"),
        pytest.param([95, 105], 100, "at 105", id="newer of two equally near"),
    ],
)
def test_the_nearest_depth_image_within_the_slop_is_chosen(
    received_ms: list[int], colour_ms: int, expected: str
) -> None:
    assert pairing(*received_ms).pair(colour_ms * MS) == expected


@pytest.mark.parametrize(
    ("received_ms", "reason"),
    [
        pytest.param([], Unpaired.MISSING, id="none received"),
        pytest.param([40, 79], Unpaired.LATE, id="the newest is too old"),
        pytest.param([40, 160], Unpaired.PASSED, id="the one between was lost"),
        pytest.param([150, 160, 170], Unpaired.PASSED, id="all are newer"),
    ],
)
def test_a_colour_image_without_a_depth_image_gets_the_reason(
    received_ms: list[int], reason: Unpaired
) -> None:
    assert pairing(*received_ms).pair(100 * MS) is reason


def test_only_the_newest_are_kept() -> None:
    depths = pairing(*range(0, 10 * FRAME_MS, FRAME_MS))
    paired = [not isinstance(depths.pair(index * FRAME_MS * MS), Unpaired) for index in range(10)]
    assert paired == [index >= 10 - CAPACITY for index in range(10)]


@pytest.mark.parametrize(
    ("before", "after"),
    [
        pytest.param([100], range(133, 2000, FRAME_MS), id="received before"),
        pytest.param([70], [103, *range(133, 2000, FRAME_MS)], id="a nearer one received after"),
    ],
)
def test_a_slow_detection_keeps_the_depth_image_of_its_beginning(
    before: list[int], after: Iterable[int]
) -> None:
    depths = pairing(*before)
    depths.expect(100 * MS)
    for stamp_ms in after:
        depths.add(stamp_ms * MS, f"at {stamp_ms}")
    assert depths.pair(100 * MS) in ("at 100", "at 103")
    depths.expect(1990 * MS)
    depths.add(2000 * MS, "at 2000")
    assert depths.pair(100 * MS) is Unpaired.PASSED


@pytest.mark.parametrize("stamp_ms", [0, 99], ids=["recording starts again", "same stamp again"])
def test_time_that_jumps_back_drops_what_was_before(stamp_ms: int) -> None:
    depths = pairing(33, 66, 99, stamp_ms)
    assert depths.pair(stamp_ms * MS) == f"at {stamp_ms}"
    assert isinstance(depths.pair(66 * MS), Unpaired)
