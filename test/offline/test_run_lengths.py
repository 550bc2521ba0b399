"""Masks as COCO's run lengths: what is read back is what was written, and the text is that of pycocotools."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from pycocotools import mask as coco
from support.coco_masks import mask_of_rle

from yolov5_lifecycle.detection.masks import Window
from yolov5_lifecycle.offline.run_lengths import coco_rle, counts_string, run_lengths

EVERY_MASK = arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, max_side=40))


def whole(mask: NDArray[np.bool_]) -> Window:
    height, width = mask.shape
    return Window(slice(0, height), slice(0, width))


def rle(mask: NDArray[np.bool_]) -> Any:
    height, width = mask.shape
    return coco_rle(whole(mask), mask, (height, width))


def discs(size_hw: tuple[int, int], seed: int) -> NDArray[np.bool_]:
    """Overlapping discs, some of them beyond the border, as long runs need them."""
    rng = np.random.default_rng(seed)
    y, x = np.ogrid[: size_hw[0], : size_hw[1]]
    mask = np.zeros(size_hw, np.bool_)
    for _ in range(5):
        centre_y, centre_x = rng.uniform((0, 0), size_hw)
        mask ^= (y - centre_y) ** 2 + (x - centre_x) ** 2 < rng.uniform(0, max(size_hw) / 2) ** 2
    return mask


@given(mask=EVERY_MASK)
def test_what_is_read_back_is_what_was_written(mask: NDArray[np.bool_]) -> None:
    written = rle(mask)
    assert written["size"] == [*mask.shape]
    np.testing.assert_array_equal(mask_of_rle(written), mask)


@given(mask=EVERY_MASK, data=st.data())
def test_a_part_of_the_image_is_written_as_the_whole_with_nothing_around_it(
    mask: NDArray[np.bool_], data: st.DataObject
) -> None:
    height, width = mask.shape
    rows, columns = (
        slice(*sorted(data.draw(st.tuples(st.integers(0, side), st.integers(0, side)))))
        for side in (height, width)
    )
    expected = np.zeros_like(mask)
    expected[rows, columns] = mask[rows, columns]
    assert coco_rle(Window(rows, columns), mask[rows, columns], (height, width)) == rle(expected)


@pytest.mark.parametrize(
    "mask",
    [
        pytest.param(np.zeros((1, 1), np.bool_), id="no pixel of one"),
        pytest.param(np.ones((1, 1), np.bool_), id="one pixel of one"),
        pytest.param(np.zeros((480, 640), np.bool_), id="no pixel"),
        pytest.param(np.ones((480, 640), np.bool_), id="every pixel"),
        pytest.param(np.arange(12).reshape(3, 4) == 0, id="the first pixel"),
        pytest.param(np.arange(12).reshape(3, 4) == 11, id="the last pixel"),
        pytest.param(np.arange(12).reshape(3, 4) == 6, id="a pixel amid others"),
        pytest.param(np.arange(5000).reshape(1, 5000) % 2 == 0, id="every other column"),
        pytest.param(np.ones((3, 4), np.bool_) & [False, True, True, False], id="columns without a gap"),
        pytest.param(discs((700, 900), 1), id="large"),
    ],
)
def test_a_mask_at_the_edge_of_the_format_is_read_back(mask: NDArray[np.bool_]) -> None:
    np.testing.assert_array_equal(mask_of_rle(rle(mask)), mask)


def test_runs_go_down_the_columns_and_begin_with_what_is_outside() -> None:
    mask = np.array([[1, 1, 0], [0, 1, 0]], np.bool_)
    np.testing.assert_array_equal(run_lengths(whole(mask), mask, (2, 3)), [0, 1, 1, 2, 2])
    np.testing.assert_array_equal(run_lengths(whole(mask), ~mask, (2, 3)), [1, 1, 2, 2])


@pytest.mark.parametrize(
    ("counts", "expected"),
    [
        ([1], "1"),
        ([0, 1], "01"),
        ([12], "<"),
        ([307200], "PP\\9"),
        ([0, 307200], "0PP\\9"),
        ([0, 1, 11], "01;"),
        ([6, 1, 5], "615"),
        ([0, 1, 1, 2, 2], "01111"),
        ([15, 16, 17, 31, 32, 33, 1000, 1, 1], "?`0a0??2Xn0POiPO"),
        ([0, 1, 200000, 3, 100000, 40, 50, 1], "01PZS62P[nLU1b\\nLiN"),
    ],
    ids=str,
)
def test_the_text_is_that_of_pycocotools(counts: list[int], expected: str) -> None:
    assert counts_string(np.array(counts, np.int64)) == expected


def test_pycocotools_writes_the_same() -> None:
    for seed in range(100):
        rng = np.random.default_rng(seed)
        height, width = rng.integers(1, 300, 2).tolist()
        for mask in (discs((height, width), seed), rng.random((height, width)) < rng.random()):
            theirs = coco.encode(np.asfortranarray(mask, np.uint8))
            assert rle(mask) == {"size": [height, width], "counts": theirs["counts"].decode()}
