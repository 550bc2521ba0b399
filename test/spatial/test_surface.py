"""The surface in a box stands before the background, and is more frequent in the box than around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.depth_scene import CAMERA, one_mask

from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.spatial.box_samples import GRID, IS_AROUND, SIDE, around, inside, is_background, sampled
from yolov5_lifecycle.spatial.camera_model import Distortion
from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.surface import Surfaces, surfaces_in

NAN = np.nan
Depth = NDArray[np.float64]

BOX = np.array([[30, 30, 50, 50]], np.float32)
"""Each of its samples is one pixel."""
IN_BOX = slice(30, 50), slice(30, 50)


def seen(depth_m: NDArray[np.float32], masks: Masks | None = None) -> Surfaces:
    """In BOX."""
    ((_, found),) = surfaces_in(BOX, DepthImage(depth_m, 1.0), CAMERA, masks)
    return found


def surface(
    inside: Depth | list[list[float]], around: float | Depth, mask: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """The surface (SIDE, SIDE) of a box that holds the rows `inside`, in a depth image of `around`.

    With a `mask` (SIDE, SIDE), of the object with these samples.
    """
    depth_m = np.full((80, 80), around, np.float32)
    depth_m[IN_BOX] = np.broadcast_to(inside, (SIDE, SIDE))
    masks = None if mask is None else one_mask(np.pad(mask, 30))
    return np.asarray(seen(depth_m, masks).metres[0])


def rows(*parts: tuple[int, float]) -> Depth:
    """(SIDE, SIDE) of so many rows of each value."""
    return np.repeat([value for _, value in parts], [count for count, _ in parts])[:, None] * np.ones(SIDE)


def extents(found: NDArray[np.float32]) -> tuple[float, float]:
    seen = found[~np.isnan(found)]
    return (float(seen.min()), float(seen.max())) if seen.size else (NAN, NAN)


@pytest.mark.parametrize(
    ("inside", "around", "expected"),
    [
        pytest.param(rows((20, NAN)), 2.0, (NAN, NAN), id="no measurement"),
        pytest.param(rows((20, 2.0)), 2.0, (2.0, 2.0), id="the same around"),
        pytest.param(rows((11, 2.0), (9, NAN)), 2.0, (2.0, 2.0), id="the same around, half measured"),
        pytest.param(rows((6, 1.0), (14, 2.0)), NAN, (1.0, 1.0), id="the nearer of two"),
        pytest.param(rows((2, 1.0), (18, 2.0)), NAN, (2.0, 2.0), id="the nearer one is too small"),
        pytest.param(rows((12, 1.0), (8, 2.0)), 1.0, (2.0, 2.0), id="the nearer one goes on around"),
        pytest.param(rows((10, 1.0), (10, 3.0)), 3.0, (1.0, 1.0), id="the farther one goes on around"),
        pytest.param(rows((10, 1.0), (4, 1.1), (6, 3.0)), 3.0, (1.0, 1.1), id="a step"),
        pytest.param(rows((10, 1.0), (4, 1.3), (6, 3.0)), 3.0, (1.0, 1.3), id="a part farther behind"),
        pytest.param(rows((10, 1.0), (4, 1.8), (6, 3.0)), 3.0, (1.0, 1.0), id="too far behind"),
    ],
)
def test_a_surface_stands_out(inside: Depth, around: float, expected: tuple[float, float]) -> None:
    np.testing.assert_allclose(extents(surface(inside, around)), expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("inside", "masked", "expected"),
    [
        pytest.param(rows((8, 1.0), (12, 2.0)), slice(8, 20), (2.0, 2.0), id="nearer beside it"),
        pytest.param(rows((12, 2.0), (8, 3.5)), slice(0, 12), (2.0, 2.0), id="farther beside it"),
        pytest.param(rows((14, 4.0), (6, 2.0)), slice(12, 18), (2.0, 2.0), id="two pixels aside"),
        pytest.param(rows((6, 1.0), (14, 2.0)), slice(0, 20), (2.0, 2.0), id="a part of what is nearer"),
        pytest.param(rows((12, 2.0), (3, 2.9), (5, 4.0)), slice(0, 20), (2.0, 2.9), id="a part behind"),
        pytest.param(rows((13, 2.0), (2, 2.9), (5, 4.0)), slice(0, 20), (2.0, 2.0), id="too small a part"),
        pytest.param(rows((20, 2.0)), slice(0, 0), (2.0, 2.0), id="empty, as without"),
        pytest.param(rows((12, 2.0), (8, NAN)), slice(14, 20), (NAN, NAN), id="not measured"),
        pytest.param(rows((14, 2.0), (6, 4.0)), slice(17, 20), (2.0, 2.0), id="only background in it"),
        pytest.param(
            rows((4, NAN), (8, 4.0), (8, NAN)), slice(4, 12), (4.0, 4.0), id="as far as the background"
        ),
    ],
)
def test_only_what_is_in_the_mask_is_the_object(
    inside: Depth, masked: slice, expected: tuple[float, float]
) -> None:
    mask = np.zeros((SIDE, SIDE), np.bool_)
    mask[masked] = True
    np.testing.assert_allclose(extents(surface(inside, 4.0, mask)), expected, rtol=1e-6)


def test_a_surface_that_recedes_is_seen_to_its_far_end() -> None:
    receding = np.linspace(1.0, 2.0, SIDE)[:, None] * np.ones(SIDE)
    found = surface(receding, 4.0)
    np.testing.assert_allclose(found, receding, rtol=0.03)


@pytest.mark.parametrize("every", [2, 3, 4])
def test_sparse_depth_has_a_surface(every: int) -> None:
    """As a lidar's that is projected into the image: pixels next to measurements are not measured."""
    depth_m = np.full((80, 80), 4.0)
    depth_m[IN_BOX] = np.linspace(1.0, 1.3, SIDE)[:, None]
    sparse = np.zeros_like(depth_m, np.float32)
    sparse[::every, ::every] = depth_m[::every, ::every]
    (found,) = seen(sparse).metres
    near, far = extents(found)
    assert near < 1.05
    assert 1.2 < far < 1.35


FLOOR_BOX = np.array([[60, 40, 100, 80]], np.float32)
ROWS, COLUMNS = np.mgrid[0:120, 0:160]
IN_FLOOR_BOX = (ROWS >= 40) & (ROWS < 80) & (COLUMNS >= 60) & (COLUMNS < 100)
FLOOR: Depth = 120 / (ROWS + 20.0)
WALL: Depth = 300 / (COLUMNS + 60.0)


def background(depth_m: Depth, box: NDArray[np.float32] = FLOOR_BOX) -> NDArray[np.bool_]:
    samples = sampled(DepthImage(depth_m.astype(np.float32), 1.0), box, CAMERA)
    return np.asarray(is_background(samples)[0])


def measured(depth_m: Depth, box: NDArray[np.float32] = FLOOR_BOX) -> NDArray[np.bool_]:
    samples = sampled(DepthImage(depth_m.astype(np.float32), 1.0), box, CAMERA)
    return np.asarray(~np.isnan(samples.metres[0]))


@pytest.mark.parametrize(
    "depth_m",
    [
        pytest.param(np.full((120, 160), 3.0), id="a wall the camera faces"),
        pytest.param(FLOOR, id="a floor"),
        pytest.param(WALL, id="a slanted wall"),
        pytest.param(np.minimum(FLOOR, 1.5), id="a floor and a wall"),
        pytest.param(np.minimum(FLOOR, 0.8 * WALL), id="a floor and a slanted wall"),
    ],
)
def test_planes_around_an_empty_box_are_all_background(depth_m: Depth) -> None:
    assert background(depth_m).mean() > 0.99


def test_a_plane_goes_on_where_the_lens_sees_nothing() -> None:
    camera = replace(CAMERA, fx=60.0, fy=60.0, distortion=Distortion("equidistant", (0.0,) * 4))
    at_the_edge = np.array([[68, 100, 100, 132]], np.float32)
    samples = sampled(DepthImage(np.full(CAMERA.size_hw, 3, np.float32), 1.0), at_the_edge, camera)
    is_measured = ~np.isnan(samples.metres)
    assert 0.7 < is_measured.mean() < 0.95
    np.testing.assert_array_equal(is_background(samples), is_measured)


def test_a_plane_is_found_in_noise_that_grows_with_the_square_of_the_depth() -> None:
    noise = np.random.default_rng(3).normal(0, 0.004, FLOOR.shape)
    assert background(FLOOR + noise * FLOOR**2).mean() > 0.97


def test_an_object_on_a_floor_is_not_background() -> None:
    board_m = np.where(IN_FLOOR_BOX, FLOOR[79, 0], FLOOR)
    found = background(board_m)
    assert inside(found[None]).mean() < 0.15  # its foot is as far away as the floor
    assert found[IS_AROUND].all()


def test_an_occluding_board_that_goes_on_beyond_the_box_is_background() -> None:
    is_board = (ROWS >= 20) & (ROWS < 60) & (COLUMNS >= 30) & (COLUMNS < 130)
    depth_m = np.where(is_board, 0.8, np.where(IN_FLOOR_BOX, 1.0, FLOOR))
    assert inside(background(depth_m)[None])[0, :9].all()
    assert not inside(background(depth_m)[None])[0, 11:18].any()


@pytest.mark.parametrize("is_across", [False, True], ids=["beside it", "above and below it"])
def test_objects_as_far_away_as_this_one_are_not_background(is_across: bool) -> None:
    depth_m = np.full((120, 160), 5.0)
    depth_m[40:80, 60:100] = 2.0
    if is_across:
        depth_m[5:35, 60:100] = depth_m[85:115, 60:100] = 2.0
    else:
        depth_m[40:80, 20:55] = depth_m[40:80, 105:140] = 2.0
    assert not inside(background(depth_m)[None]).any()


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_what_is_not_measured_is_not_background(value: float) -> None:
    is_hole = (ROWS + COLUMNS) % 3 == 0
    depth_m = np.where(is_hole, value, FLOOR)
    np.testing.assert_array_equal(background(depth_m), measured(depth_m))


def test_random_depth_has_no_background_plane() -> None:
    depth_m = np.random.default_rng(0).uniform(0.5, 8, (120, 160))
    assert around(background(depth_m)[None]).mean() < 0.1


def test_the_samples_lie_in_the_box_and_on_a_ring_around_it() -> None:
    """Each pixel holds its own place: the column in whole metres, the row in 1/256."""
    columns, rows = np.meshgrid(np.arange(1, 120), np.arange(1, 160) / 256)
    depth = DepthImage((columns + rows).astype(np.float32)[:, :19], 1.0)
    metres = sampled(depth, np.array([[4, 20, 14, 120]], np.float32), CAMERA).metres
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
    boxes = np.array([[30, 20, 60, 40], [10, 12, 30, 44]], np.float32)
    samples = sampled(DepthImage(values, 1.0), boxes, CAMERA)
    for box in range(2):
        expected = values[samples.rows[box][:, None], samples.columns[box][None, :]]
        np.testing.assert_array_equal(samples.metres[box], expected)
