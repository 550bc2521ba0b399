"""Points lie on the objects' own surfaces, where the camera sees them, as far apart as was asked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.depth_scene import CAMERA, LENSES, THIN, Difficulty, pixels, random_depth_scene
from support.floor_scene import random_floor_scene
from support.solids import KINDS

from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.images.image import MAX_SIDE_PX
from yolov5_lifecycle.spatial.box_samples import SIDE
from yolov5_lifecycle.spatial.camera_model import Distortion, Intrinsics
from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.points import MAX_PIXELS, surface_points
from yolov5_lifecycle.spatial.surface import MAX_BOXES_AT_ONCE, Surfaces, surfaces_in

Boxes = NDArray[np.float32]

BOARD = slice(80, 140), slice(100, 180)
BOX: Boxes = np.array([[99, 79, 181, 141]], np.float32)


def board_before_wall(board_m: float = 2.0) -> NDArray[np.float32]:
    depth_m = np.full(CAMERA.size_hw, 4, np.float32)
    depth_m[BOARD] = board_m
    return depth_m


class Found(NamedTuple):
    """Points of all objects, one object after the other."""

    xyz_m: NDArray[np.float32]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    boxes: NDArray[np.intp]


def points_in(
    boxes_xyxy: Boxes,
    depth: DepthImage,
    camera: Intrinsics,
    masks: Masks | None = None,
    spacing_m: float = 0.0,
) -> Found:
    surfaces = surfaces_in(boxes_xyxy, depth, camera, masks)
    found = [(np.zeros((0, 3), np.float32), *[np.zeros(0, np.intp)] * 3)]
    for of_object in surface_points(surfaces, depth, camera, spacing_m=spacing_m):
        boxes = np.full(len(of_object.rows), of_object.box)
        found.append((of_object.xyz_m, of_object.rows, of_object.columns, boxes))
    return Found(*map(np.concatenate, zip(*found, strict=True)))


def points(depth_m: NDArray[np.float32], boxes_xyxy: Boxes = BOX, spacing_m: float = 0.0) -> Found:
    return points_in(boxes_xyxy, DepthImage(depth_m, 1.0), CAMERA, spacing_m=spacing_m)


def test_a_board_has_a_point_for_each_of_its_pixels_and_the_wall_behind_it_has_none() -> None:
    depth_m = board_before_wall()
    depth_m[100, 120:130] = 0, np.nan, np.inf, -1, 1e9, 0, 0, 0, 0, 0
    found = points(depth_m)
    shown = np.zeros(CAMERA.size_hw, np.bool_)
    shown[found.rows, found.columns] = True
    np.testing.assert_array_equal(shown, depth_m == 2)
    assert len(found.rows) == shown.sum(), "one a pixel"
    assert found.xyz_m.dtype == np.float32
    expected = np.stack((found.columns - CAMERA.cx, found.rows - CAMERA.cy), axis=1) / CAMERA.fx * 2
    np.testing.assert_allclose(found.xyz_m[:, :2], expected, atol=1e-5)
    assert set(found.xyz_m[:, 2]) == {2}


def test_each_object_has_its_own_points() -> None:
    depth_m = board_before_wall()
    depth_m[20:60, 20:60] = 1
    boxes_xyxy = np.array([[19, 19, 61, 61], [200, 200, 240, 230], *BOX], np.float32)
    depth_m[200:230, 200:240] = 0
    found = points(depth_m, boxes_xyxy)
    assert (np.diff(found.boxes) >= 0).all()
    distances = {int(box): set(found.xyz_m[found.boxes == box, 2]) for box in set(found.boxes)}
    assert distances == {0: {1}, 2: {2}}, "what is not measured has no points"


def test_an_object_has_the_same_points_alone_and_beside_a_nearer_one() -> None:
    depth_m = board_before_wall()
    depth_m[20:60, 20:60] = 1
    boxes_xyxy = np.array([[19, 19, 61, 61], *BOX], np.float32)
    found, alone = (points(depth_m, boxes, spacing_m=0.02) for boxes in (boxes_xyxy, BOX))
    np.testing.assert_array_equal(found.xyz_m[found.boxes == 1], alone.xyz_m)


def test_what_was_found_beside_an_object_is_none_of_its_points() -> None:
    """Although it is hardly farther away; for the first of two boxes that are alike, nothing was found."""
    depth_m = board_before_wall()
    depth_m[:, 140:] = 2.05
    metres = np.full((2, SIDE, SIDE), 2, np.float32)
    beside_m = np.full_like(metres, np.nan)
    beside_m[1, :, SIDE // 2 :] = 2.05
    surfaces = Surfaces(np.repeat(BOX, 2, axis=0), metres, beside_m)
    first, second = surface_points(surfaces, DepthImage(depth_m, 1.0), CAMERA)
    assert (set(first.columns), set(second.columns)) == ({*range(100, 181)}, {*range(100, 140)})


def test_a_box_between_two_pixels_has_no_points() -> None:
    """As that of an object which has nearly left the image."""
    found = points(np.full(CAMERA.size_hw, 3, np.float32), np.array([[319.7, 50, 320, 150]], np.float32))
    assert len(found.rows) == 0
    assert {found.rows.dtype, found.columns.dtype} == {np.dtype(np.intp)}, "indices of pixels"


@pytest.mark.parametrize(
    ("spacing_m", "step_xy_px"),
    [
        pytest.param(0.015, (2, 2), id="two pixels"),
        pytest.param(0.03, (4, 3), id="four pixels, or as far as samples are"),
        pytest.param(10, (4, 3), id="as far as samples are"),
    ],
)
def test_points_are_as_far_apart_as_was_asked(spacing_m: float, step_xy_px: tuple[int, int]) -> None:
    found = points(board_before_wall(), spacing_m=spacing_m)
    for places, step_px in zip((found.columns, found.rows), step_xy_px, strict=True):
        steps = np.diff(np.unique(places)).tolist()
        assert (np.median(steps), max(steps)) == (step_px, step_px)
    assert len(found.rows) == len({*found.rows}) * len({*found.columns}), "one in each block"


@pytest.mark.parametrize("spacing_m", [0, 0.02, 0.05])
def test_sparse_depth_keeps_its_points_at_every_spacing(spacing_m: float) -> None:
    """As a lidar's that is projected into the image."""
    sparse = np.zeros(CAMERA.size_hw, np.float32)
    sparse[1::4, 2::3] = board_before_wall()[1::4, 2::3]
    assert len(points(sparse, spacing_m=spacing_m).rows) > 0.5 * (sparse == 2).sum()


def test_a_wall_a_little_behind_the_object_has_no_points() -> None:
    depth_m = np.full(CAMERA.size_hw, 2.1, np.float32)
    depth_m[BOARD] = 2
    assert set(points(depth_m).xyz_m[:, 2]) == {2}


def test_a_small_object_keeps_its_points_however_far_apart_they_are() -> None:
    depth_m = board_before_wall(board_m=4.0)
    depth_m[80:100, 100:103] = 0.5
    found = points(depth_m, np.array([[99, 79, 104, 101]], np.float32), spacing_m=10)
    assert len(found.rows) == 60


def test_of_many_boxes_each_point_names_its_own() -> None:
    beyond = np.array([[-(10**6), -(10**6), 10**6, 10**6]], np.float32)
    boxes_xyxy = np.repeat(BOX, MAX_BOXES_AT_ONCE + 6, axis=0)
    boxes_xyxy[::2] += 200  # nothing stands out there
    found = points(board_before_wall(), np.concatenate((boxes_xyxy, beyond)))
    counts = np.bincount(found.boxes, minlength=len(boxes_xyxy))
    assert (counts[1 : len(boxes_xyxy) : 2] == 60 * 80).all(), "a box beyond the image thins no other"


@pytest.mark.parametrize("kind", KINDS)
def test_points_lie_on_the_object_and_cover_it(kind: str) -> None:
    rng = np.random.default_rng(31)
    shares = []
    for _ in range(10):
        scene = random_floor_scene(rng, kind, has_company=True)
        depth = DepthImage(scene.depth_m, 1.0)
        found = points_in(scene.box_xyxy[None], depth, scene.camera, scene.masks())
        hits = scene.mask[found.rows, found.columns]
        shares.append((hits.mean(), hits.sum() / (scene.mask & (scene.depth_m > 0)).sum()))
    on_object, covered = np.median(shares, axis=0)
    assert on_object > 0.95
    assert covered > 0.7


def test_with_masks_equal_objects_in_a_row_are_told_apart() -> None:
    rng = np.random.default_rng(32)
    shares = []
    for shape in THIN * 5:
        scene = random_depth_scene(rng, shape, Difficulty(hole_share=0.3, has_neighbours=True))
        depth = DepthImage(scene.depth_m, 1.0)
        found = points_in(scene.box_xyxy[None], depth, CAMERA, scene.masks())
        shares.append(scene.mask[found.rows, found.columns].mean())
    assert min(shares) > 0.9


def test_a_pixel_without_a_ray_has_no_point() -> None:
    camera = Intrinsics(100.0, 100.0, 160.0, 120.0, (240, 320), Distortion("equidistant", (0.0,) * 4))
    depth = DepthImage(np.full(camera.size_hw, 3, np.float32), 1.0)
    found = points_in(np.array([[0, 0, 320, 240]], np.float32), depth, camera)
    assert 50_000 < len(found.rows) < 320 * 240
    assert np.isfinite(found.xyz_m).all()


@pytest.mark.parametrize("lens", LENSES)
def test_points_are_where_the_lens_shows_them(lens: str) -> None:
    camera, box = LENSES[lens], np.array([[60, 50, 260, 190]], np.float32)
    depth = DepthImage(np.full(camera.size_hw, 3, np.float32), 1.0)
    found = points_in(box, depth, camera)
    assert len(found.rows) == 200 * 140
    columns, rows = pixels(camera, found.xyz_m[:, :2].T.astype(np.float64) / 3)
    np.testing.assert_allclose(columns, found.columns, atol=0.1)
    np.testing.assert_allclose(rows, found.rows, atol=0.1)


@pytest.mark.parametrize(
    "boxes_xyxy",
    [
        pytest.param(np.zeros((0, 4)), id="none"),
        pytest.param([[50, 50, 50, 50]], id="without pixels"),
        pytest.param([[-50, -50, -10, -10], [400, 300, 500, 400]], id="outside the image"),
    ],
)
def test_boxes_that_show_nothing_have_no_points(boxes_xyxy: list[list[float]]) -> None:
    found = points(board_before_wall(), np.asarray(boxes_xyxy, np.float32))
    assert (found.xyz_m.shape, found.rows.shape, found.boxes.shape) == ((0, 3), (0,), (0,))


def test_a_large_image_has_points_in_bounded_number() -> None:
    height, width = size_hw = MAX_SIDE_PX // 4, MAX_SIDE_PX
    values = np.broadcast_to(np.uint16(2000), size_hw)
    camera = Intrinsics(9000.0, 9000.0, width / 2, height / 2, size_hw)
    everywhere = np.repeat(np.array([[0, 0, width, height]], np.float32), 3, axis=0)
    found = points_in(everywhere, DepthImage(values, 0.001), camera)
    assert 0.8 * MAX_PIXELS < len(found.rows) <= MAX_PIXELS


@given(
    data=st.binary(max_size=64),
    ends=st.lists(st.tuples(*[st.floats(-50, 400, width=32)] * 4), max_size=4),
    spacing_m=st.floats(0, 10),
)
@settings(max_examples=20)
def test_any_values_and_boxes_give_finite_points(
    data: bytes, ends: list[tuple[float, ...]], spacing_m: float
) -> None:
    values = np.resize(np.frombuffer(data or b"\0", np.uint8), 320 * 240 * 4).view("<f4").reshape(240, 320)
    boxes_xyxy = np.sort(np.array(ends, np.float32).reshape(-1, 2, 2), axis=1).reshape(-1, 4)
    assert np.isfinite(points(values, boxes_xyxy, spacing_m).xyz_m).all()
