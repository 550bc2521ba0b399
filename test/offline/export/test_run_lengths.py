"""Masks as COCO's run lengths: those that pycocotools writes for the whole image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from pycocotools import mask as coco

from yolov5_lifecycle.detection.masks import Window
from yolov5_lifecycle.offline.export.formats import coco_rle

EVERY_MASK = arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, max_side=40))


def check(mask: NDArray[np.bool_], window: Window) -> None:
    """Expect what pycocotools writes for a mask without the pixels outside of `window`."""
    whole = np.zeros(mask.shape, np.uint8, order="F")
    whole[window] = mask[window]
    theirs = coco.encode(whole)
    height, width = mask.shape
    assert coco_rle(window, mask[window], (height, width)) == {
        "size": [height, width],
        "counts": theirs["counts"].decode(),
    }


def part(data: st.DataObject, side: int) -> slice:
    return slice(*sorted(data.draw(st.tuples(st.integers(0, side), st.integers(0, side)))))


@given(mask=EVERY_MASK, data=st.data())
def test_a_part_of_the_image_is_written_as_the_whole_with_nothing_around_it(
    mask: NDArray[np.bool_], data: st.DataObject
) -> None:
    height, width = mask.shape
    check(mask, Window(slice(0, height), slice(0, width)))
    check(mask, Window(part(data, height), part(data, width)))


@pytest.mark.parametrize("seed", [1, 4])
def test_long_runs_are_written_as_pycocotools_does(seed: int) -> None:
    """Overlapping discs, some of them beyond the border."""
    rng = np.random.default_rng(seed)
    height, width = rng.integers(300, 900, 2).tolist()
    y, x = np.ogrid[:height, :width]
    mask = np.zeros((height, width), np.bool_)
    for _ in range(seed):
        centre_y, centre_x = rng.uniform((0, 0), (height, width))
        mask ^= (y - centre_y) ** 2 + (x - centre_x) ** 2 < rng.uniform(0, width / 2) ** 2
    check(mask, Window(slice(0, height), slice(0, width)))
    check(~mask, Window(slice(0, height), slice(0, width)))
