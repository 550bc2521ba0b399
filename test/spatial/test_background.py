"""Planes that go on around a box are its background; what stands before them is not."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from yolov5_lifecycle.spatial.background import is_background
from yolov5_lifecycle.spatial.box_samples import IS_AROUND, around, inside, sampled
from yolov5_lifecycle.spatial.depth_image import DepthImage

Depth = NDArray[np.float64]

BOX = np.array([[60, 40, 100, 80]], np.float32)
ROWS, COLUMNS = np.mgrid[0:120, 0:160]
IN_BOX = (ROWS >= 40) & (ROWS < 80) & (COLUMNS >= 60) & (COLUMNS < 100)
FLOOR: Depth = 120 / (ROWS + 20.0)
WALL: Depth = 300 / (COLUMNS + 60.0)


def background(depth_m: Depth, box: NDArray[np.float32] = BOX) -> NDArray[np.bool_]:
    samples = sampled(DepthImage(depth_m.astype(np.float32), 1.0), box)
    return np.asarray(is_background(samples)[0])


def measured(depth_m: Depth, box: NDArray[np.float32] = BOX) -> NDArray[np.bool_]:
    samples = sampled(DepthImage(depth_m.astype(np.float32), 1.0), box)
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


def test_a_plane_is_found_in_noise_that_grows_with_the_square_of_the_depth() -> None:
    noise = np.random.default_rng(3).normal(0, 0.004, FLOOR.shape)
    assert background(FLOOR + noise * FLOOR**2).mean() > 0.97


def test_an_object_on_a_floor_is_not_background() -> None:
    board_m = np.where(IN_BOX, FLOOR[79, 0], FLOOR)
    found = background(board_m)
    assert inside(found[None]).mean() < 0.15  # its foot is as far away as the floor
    assert found[IS_AROUND].all()


def test_an_occluding_board_that_goes_on_beyond_the_box_is_background() -> None:
    is_board = (ROWS >= 20) & (ROWS < 60) & (COLUMNS >= 30) & (COLUMNS < 130)
    depth_m = np.where(is_board, 0.8, np.where(IN_BOX, 1.0, FLOOR))
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


def test_a_floor_at_the_lower_edge_of_the_image_is_background() -> None:
    box = np.array([[60, 80, 100, 120]], np.float32)
    is_object = (ROWS >= 80) & (COLUMNS >= 60) & (COLUMNS < 100)
    depth_m = np.where(is_object, 0.7, np.minimum(FLOOR, 1.1))
    found, seen = background(depth_m, box), measured(depth_m, box)
    assert found[IS_AROUND & seen].mean() > 0.97
    assert not inside(found[None]).any()


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_what_is_not_measured_is_not_background(value: float) -> None:
    is_hole = (ROWS + COLUMNS) % 3 == 0
    depth_m = np.where(is_hole, value, FLOOR)
    np.testing.assert_array_equal(background(depth_m), measured(depth_m))


def test_without_measurements_there_is_no_background() -> None:
    assert not background(np.zeros((120, 160))).any()


def test_a_few_measurements_around_a_box_are_no_plane() -> None:
    depth_m = np.where(IN_BOX, 2.0, 0.0)
    depth_m[84:92, 66:72] = 2.0
    assert measured(depth_m)[IS_AROUND].sum() >= 9
    assert not background(depth_m).any()


def test_random_depth_has_no_background_plane() -> None:
    depth_m = np.random.default_rng(0).uniform(0.5, 8, (120, 160))
    assert around(background(depth_m)[None]).mean() < 0.1
