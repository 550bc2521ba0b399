"""A box is sampled on a grid in it and on a ring around it."""

from __future__ import annotations

import numpy as np

from yolov5_lifecycle.spatial.box_samples import GRID, SIDE, around, inside, sampled
from yolov5_lifecycle.spatial.depth_image import DepthImage


def test_the_samples_lie_in_the_box_and_on_a_ring_around_it() -> None:
    """Each pixel holds its own place: the column in whole metres, the row in 1/256."""
    columns, rows = np.meshgrid(np.arange(1, 120), np.arange(1, 160) / 256)
    depth = DepthImage((columns + rows).astype(np.float32)[:, :19], 1.0)
    metres = sampled(depth, np.array([[4, 20, 14, 120]], np.float32)).metres
    assert metres.shape == (1, GRID, GRID)
    in_box, on_ring = inside(metres)[0], around(metres)[0]
    assert in_box.shape == (SIDE, SIDE)
    on_ring = on_ring[~np.isnan(on_ring)]
    assert set(np.floor(in_box.ravel())) == set(range(5, 15))
    np.testing.assert_allclose(sorted({*np.round(in_box.ravel() % 1 * 256)}), np.arange(20, 120, 5) + 3)
    columns_around = np.floor(on_ring)
    is_beside = (columns_around < 5) | (columns_around > 14)
    rows_around = np.round(on_ring % 1 * 256)
    assert {*columns_around[is_beside]} == {1, 2, 3, 17, 18, 19}
    assert {*rows_around[~is_beside]} <= {*range(1, 10), *range(133, 150)}


def test_the_samples_know_their_pixels() -> None:
    values = np.arange(1, 1 + 60 * 80, dtype=np.float32).reshape(60, 80) / 10
    samples = sampled(DepthImage(values, 1.0), np.array([[30, 20, 60, 40], [10, 12, 30, 44]], np.float32))
    for box in range(2):
        expected = values[samples.rows[box][:, None], samples.columns[box][None, :]]
        np.testing.assert_array_equal(samples.metres[box], expected)


def test_far_outside_there_are_no_samples() -> None:
    depth = DepthImage(np.ones((10, 10), np.float32), 1.0)
    samples = sampled(depth, np.array([[1e9, 1e9, 2e9, 2e9], [-2e9, 0, -1e9, 9]], np.float32))
    assert np.isnan(samples.metres).all()
