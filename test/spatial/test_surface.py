"""The surface in a box stands before the background, and is more frequent in the box than around it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.depth_scene import CAMERA, one_mask

from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.spatial.box_samples import (
    GRID,
    IS_AROUND,
    RING,
    SIDE,
    BoxSamples,
    around,
    inside,
    is_on_plane_beyond,
    is_on_surface_beyond,
    sampled,
)
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
    return surfaces_in(BOX, DepthImage(depth_m, 1.0), CAMERA, masks)


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
        pytest.param(rows((7, 1.0), (13, 2.0)), NAN, (1.0, 1.0), id="the nearer of two"),
        pytest.param(rows((6, 1.0), (14, 2.0)), NAN, (2.0, 2.0), id="the nearer one is too small"),
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
        pytest.param(rows((14, 2.0), (1, 2.9), (5, 4.0)), slice(0, 20), (2.0, 2.0), id="too small a part"),
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


def samples_of(depth_m: Depth) -> BoxSamples:
    """Those of FLOOR_BOX."""
    return sampled(DepthImage(depth_m.astype(np.float32), 1.0), FLOOR_BOX, CAMERA)


def background(depth_m: Depth) -> NDArray[np.bool_]:
    return np.asarray(is_on_plane_beyond(samples_of(depth_m))[0])


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
    np.testing.assert_array_equal(is_on_plane_beyond(samples), is_measured)


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
    np.testing.assert_array_equal(background(depth_m), ~np.isnan(samples_of(depth_m).metres[0]))


def test_random_depth_has_no_background_plane() -> None:
    depth_m = np.random.default_rng(0).uniform(0.5, 8, (120, 160))
    assert around(background(depth_m)[None]).mean() < 0.1


def beyond(depth_m: Depth, is_free: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """Which samples (GRID, GRID) of FLOOR_BOX are on a surface that goes on, if no plane is known."""
    samples = samples_of(depth_m)
    free = ~np.isnan(samples.metres) if is_free is None else is_free[None]
    return np.asarray(is_on_surface_beyond(samples, free)[0])


CRATE = np.maximum(60 / (ROWS + 1.0), 0.9)
"""Its top and its front, the edge between them at row 66."""
IS_CRATE = (ROWS >= 55) & (COLUMNS >= 30) & (COLUMNS < 130)


def test_a_crate_that_hides_a_part_goes_on_with_its_top_and_its_front() -> None:
    found = beyond(np.where(IS_CRATE, CRATE, np.where(IN_FLOOR_BOX, 2.0, 5.0)))
    assert not inside(found[None])[0, :7].any()
    assert inside(found[None])[0, 8:].all()
    assert found[IS_AROUND].all()


def test_what_stands_on_a_floor_is_not_connected_with_it() -> None:
    floor_m = np.where(ROWS > 45, 60 / np.maximum(ROWS - 40, 1), 12.0)
    found = beyond(np.where(IN_FLOOR_BOX, floor_m[79, 0], floor_m))
    assert inside(found[None]).mean() < 0.1
    assert found[-RING:].all()


@pytest.mark.parametrize(
    ("depth_of_row", "is_one"),
    [
        pytest.param(lambda row: 2.0 + 0.01 * (row >= 12), True, id="a step of 0.5 %"),
        pytest.param(lambda row: 2.0 + 0.1 * (row >= 12), False, id="a step of 5 %"),
        pytest.param(lambda row: 2.0 * 1.1 ** np.maximum(12 - row, 0), True, id="slanted"),
        pytest.param(
            lambda row: 2.0 * 1.2 ** np.maximum(12 - row, 0), False, id="too slanted to tell from a step"
        ),
        pytest.param(lambda row: 2.0 * 1.08 ** -abs(row - 12), False, id="an inner corner"),
        pytest.param(lambda row: 2.0 * 1.08 ** abs(row - 12), True, id="an outer edge"),
    ],
)
def test_a_surface_ends_at_steps_and_inner_corners(
    depth_of_row: Callable[[Depth], Depth], is_one: bool
) -> None:
    """A post that reaches from below to the fifth row of samples in the box."""
    row = (ROWS - 40) / 2
    is_post = (row >= 4) & (COLUMNS >= 70) & (COLUMNS < 90)
    depth_m = np.where(is_post, depth_of_row(row), np.where(IN_FLOOR_BOX, 40.0, 99.0))
    found = inside(beyond(depth_m)[None])[0, :, 5:15]
    assert found[14:].all()
    assert found[4:11].all() == is_one
    assert not found[:4].any()


@pytest.mark.parametrize(
    ("in_box", "on_ring", "is_found"),
    [
        pytest.param(slice(0, 10), slice(0, 3), True, id="much beyond"),
        pytest.param(slice(0, 10), slice(3, 3), False, id="nothing beyond"),
        pytest.param(slice(0, 8), slice(2, 3), True, id="a little beyond"),
        pytest.param(slice(0, 16), slice(0, 3), True, id="most of what is in the box"),
        pytest.param(slice(0, 18), slice(2, 3), False, id="too little of what is in the box"),
        pytest.param(slice(0, 18), slice(0, 3), False, id="hardly anything else in the box"),
    ],
)
def test_a_surface_goes_on_if_enough_of_it_is_beyond_the_box(
    in_box: slice, on_ring: slice, is_found: bool
) -> None:
    is_free = np.zeros((GRID, GRID), np.bool_)
    inside(is_free[None])[0, in_box] = True
    inside(is_free[None])[0, in_box.stop + 1 :] = True  # something else
    is_free[on_ring, RING:-RING] = True
    found = inside(beyond(np.full((120, 160), 2.0), is_free)[None])[0]
    assert found[in_box].all() == found.any() == is_found
    assert not found[in_box.stop :].any()


@pytest.mark.parametrize(("columns", "is_found"), [(2, False), (4, True)], ids=["2 %", "4 %"])
def test_a_few_samples_beyond_the_box_are_no_surface_there(columns: int, is_found: bool) -> None:
    is_free = np.zeros((GRID, GRID), np.bool_)
    is_free[:RING, RING : RING + columns] = True
    inside(is_free[None])[0, :2] = inside(is_free[None])[0, -5:] = True
    assert beyond(np.full((120, 160), 2.0), is_free).any() == is_found


@pytest.mark.parametrize("size_wh", [(8, 8), (16, 24), (30, 34), (50, 12), (40, 80)])
@pytest.mark.parametrize("shift", [0.0, 0.3, 0.6])
def test_a_slanted_surface_is_one_in_boxes_of_every_size(size_wh: tuple[int, int], shift: float) -> None:
    corner = np.array((60.0, 30.0)) + shift
    box = np.array([[*corner, *(corner + size_wh)]], np.float32)
    slanted_m = (2 * np.exp(0.03 * (90 - ROWS - COLUMNS))).astype(np.float32)
    samples = sampled(DepthImage(slanted_m, 1.0), box, CAMERA)
    is_free = np.ones((1, GRID, GRID), np.bool_)
    is_free[0, RING + 5 : -RING] &= IS_AROUND[RING + 5 : -RING]
    is_free[0, RING + 7 : -RING, RING:-RING] = True  # the object, apart from it
    is_free[0, RING + 6 :, : RING + 1] = is_free[0, RING + 6 :, -RING - 1 :] = is_free[0, -RING:] = False
    found = inside(is_on_surface_beyond(samples, is_free))[0]
    assert found[:5].all()
    assert not found[5:].any()


def test_what_would_leave_only_planes_is_the_object() -> None:
    is_free = np.zeros((GRID, GRID), np.bool_)
    is_free[: RING + 9] = True
    assert not beyond(np.full((120, 160), 2.0), is_free).any()


def test_a_curved_thing_that_hides_half_of_it_is_not_the_object() -> None:
    """A barrel at the left, of which no plane explains much."""
    barrel_m = 1.5 - np.sqrt(np.maximum(0.25 - ((COLUMNS - 62) / 60) ** 2, 0))
    depth_m = np.where(IN_FLOOR_BOX, 2.5, 9.0)
    depth_m[:, 45:79] = barrel_m[:, 45:79]
    found = surfaces_in(FLOOR_BOX, DepthImage(depth_m.astype(np.float32), 1.0), CAMERA)
    assert extents(found.metres[0]) == (2.5, 2.5)


def test_a_surface_is_not_continued_in_the_next_box() -> None:
    """The first one's lowest samples are next to the second one's highest."""
    depth = DepthImage(np.full((120, 160), 2, np.float32), 1.0)
    samples = sampled(depth, np.concatenate((FLOOR_BOX, FLOOR_BOX)), CAMERA)
    is_free = np.zeros((2, GRID, GRID), np.bool_)
    is_free[0, RING : RING + 10, RING:-RING] = is_free[0, RING + 9 :, RING] = is_free[1, :RING] = True
    is_free[0, RING + 11 : RING + 15, RING + 5 : -RING] = True
    assert not is_on_surface_beyond(samples, is_free)[0].any()


def test_what_goes_on_beyond_the_box_still_tells_what_is_seen_through_the_object() -> None:
    """A post at the right, and the same distance in a hole of the object."""
    depth_m = np.full((80, 80), 9, np.float32)
    depth_m[IN_BOX] = 3
    depth_m[:, 48:] = depth_m[36:44, 36:44] = 4
    assert extents(seen(depth_m).metres[0]) == (3.0, 3.0)


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
