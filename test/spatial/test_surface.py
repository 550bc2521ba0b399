"""The surface in a box is what is more frequent in it than around it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.depth_image import MIN_DEPTH_M, DepthImage
from yolov5_lifecycle.spatial.surface import SIDE, BoxSamples, sampled, surface_extents_m

BIN = math.log(1.025)
NAN = math.nan
DEPTHS_M = (NAN, MIN_DEPTH_M, 0.5, 1.0, 1.02, 1.05, 1.08, 1.1, 1.5, 2.0, 2.04, 2.1, 4.0, 4.2)


def surface(inside: list[float], around: list[float]) -> tuple[float, float]:
    found = surface_extents_m(BoxSamples(np.array([inside], np.float32), np.array([around], np.float32)))
    assert found.shape == (1, 2)
    return float(found[0, 0]), float(found[0, 1])


def frequencies(metres: list[float], bins: range, min_share: float) -> list[float]:
    """For each bin the share of the measurements that lie in it or in one of its neighbours."""
    numbers = [bin_of(value) for value in metres if not math.isnan(value)]
    total = max(len(numbers), len(metres) * min_share, 1)
    return [sum(abs(number - each) <= 1 for number in numbers) / total for each in bins]


def bin_of(metres: float) -> int:
    return int(max(np.log(np.float32(metres) / np.float32(MIN_DEPTH_M)) / np.float32(BIN), 0))


def slow_surface(inside: list[float], around: list[float]) -> tuple[float, float]:
    """The same, one bin and one sample after the other."""
    numbers = [bin_of(value) for value in inside if not math.isnan(value)]
    if not numbers:
        return NAN, NAN
    bins = range(min(numbers) - 2, max(numbers) + 3)
    share = frequencies(inside, bins, 0.0)
    ring = frequencies(around, bins, 0.25)
    excess = [own - 2.5 * other for own, other in zip(share, ring, strict=True)]
    is_alone = max(excess) < 0.03
    if is_alone:
        excess = share
    if len(numbers) < (0.5 if is_alone else 0.05) * len(inside):
        return NAN, NAN
    peak = next(
        place
        for place, value in enumerate(excess)
        if value >= 0.2 * max(excess) and value == max(excess[max(place - 1, 0) : place + 2])
    )
    first = last = peak
    while first > 0 and excess[first - 1] > 0.2 * excess[peak]:
        first -= 1
    while last + 1 < len(excess) and excess[last + 1] > 0.2 * excess[peak]:
        last += 1
    chosen = sorted(
        value for value in inside if not math.isnan(value) and bins[first] <= bin_of(value) <= bins[last]
    )
    if not chosen:
        return NAN, NAN
    ends = [round((len(chosen) - 1) * share) for share in (0.03, 0.97)]
    return chosen[ends[0]], chosen[ends[1]]


@pytest.mark.parametrize("kinds", [1, 2, 3, 4, 14])
def test_the_surface_is_that_of_the_slow_search(kinds: int) -> None:
    """Not with hypothesis: it looks for ties with a threshold, which rounding decides."""
    rng = np.random.default_rng(kinds)
    for _ in range(200):
        inside, around = (
            rng.choice(rng.choice(DEPTHS_M, kinds, replace=False), count).tolist()
            for count in (rng.integers(20, 60), 20)
        )
        np.testing.assert_allclose(surface(inside, around), slow_surface(inside, around), rtol=1e-6)


@pytest.mark.parametrize(
    ("inside", "around", "expected"),
    [
        pytest.param([NAN] * 100, [2.0] * 50, (NAN, NAN), id="no measurement"),
        pytest.param([2.0] * 100, [NAN] * 50, (2.0, 2.0), id="nothing around"),
        pytest.param([2.0] * 100, [2.0] * 50, (2.0, 2.0), id="the same around"),
        pytest.param([2.0] * 49 + [NAN] * 51, [2.0] * 50, (NAN, NAN), id="the same around, few measured"),
        pytest.param([1.0] * 5 + [NAN] * 95, [2.0] * 50, (1.0, 1.0), id="just enough measured"),
        pytest.param([1.0] * 4 + [NAN] * 96, [2.0] * 50, (NAN, NAN), id="too little measured"),
        pytest.param([1.0] * 30 + [2.0] * 70, [NAN] * 50, (1.0, 1.0), id="the nearer of two"),
        pytest.param([1.0] * 10 + [2.0] * 90, [NAN] * 50, (2.0, 2.0), id="the nearer one is too small"),
        pytest.param([MIN_DEPTH_M] * 90 + [NAN] * 10, [2.0] * 50, (0.01, 0.01), id="as near as possible"),
        pytest.param([1.0] * 60 + [2.0] * 40, [1.0] * 50, (2.0, 2.0), id="the nearer one goes on around"),
    ],
)
def test_a_surface_stands_out(
    inside: list[float], around: list[float], expected: tuple[float, float]
) -> None:
    np.testing.assert_allclose(surface(inside, around), expected)


def test_the_samples_lie_in_the_box_and_on_a_ring_around_it() -> None:
    """Each pixel holds its own place: the column in whole metres, the row in 1/256."""
    columns, rows = np.meshgrid(np.arange(1, 120), np.arange(1, 160) / 256)
    depth = DepthImage((columns + rows).astype(np.float32)[:, :19], 1.0)
    samples = sampled(depth, np.array([[4, 20, 14, 120]], np.float32))
    assert samples.inside.shape == (1, SIDE * SIDE)
    inside, around = samples.inside[0], samples.around[0][~np.isnan(samples.around[0])]
    assert set(np.floor(inside)) == set(range(5, 15))
    np.testing.assert_allclose(sorted({*np.round(inside % 1 * 256)}), np.arange(20, 120, 5) + 3)
    columns_around = np.floor(around)
    is_beside = (columns_around < 5) | (columns_around > 14)
    rows_around = np.round(around % 1 * 256)
    assert {*columns_around[is_beside]} == {1, 2, 3, 17, 18, 19}
    assert {*rows_around[~is_beside]} <= {*range(1, 10), *range(133, 150)}


def nothing_is_read_outside(values: NDArray[np.float32]) -> bool:
    return bool(np.isnan(values).all())


def test_far_outside_there_are_no_samples() -> None:
    depth = DepthImage(np.ones((10, 10), np.float32), 1.0)
    samples = sampled(depth, np.array([[1e9, 1e9, 2e9, 2e9], [-2e9, 0, -1e9, 9]], np.float32))
    assert nothing_is_read_outside(samples.inside)
    assert nothing_is_read_outside(samples.around)
