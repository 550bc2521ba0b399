"""Boxes and a depth image become boxes in space near the ground truth, or a reason."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.depth_scene import (
    CAMERA,
    LENSES,
    SHAPES,
    THIN,
    DepthScene,
    Difficulty,
    Shape,
    bounds,
    random_depth_scene,
    tight_box,
)
from support.floor_scene import View, random_floor_scene, rendered, room
from support.solids import KINDS, Cuboid

from yolov5_lifecycle.detection.masks import Masks
from yolov5_lifecycle.images.image import MAX_SIDE_PX
from yolov5_lifecycle.spatial.camera_model import Distortion, Intrinsics
from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.placement import Box3D, Placement, Unplaced, place, unusable
from yolov5_lifecycle.spatial.surface import MAX_BOXES_AT_ONCE, surfaces_in

SIZE_HW = CAMERA.size_hw
DIFFICULTIES = {
    "sloped background": Difficulty(),
    "30 % holes": Difficulty(hole_share=0.3),
    "half occluded": Difficulty(hole_share=0.3, is_half_occluded=True),
    "on a floor": Difficulty(hole_share=0.3, stands_on_floor=True),
}
SCENES_PER_SHAPE = 16
SOLID = tuple(shape for shape in SHAPES if shape not in THIN)

Boxes = NDArray[np.float32]


def in_metres(depth_m: NDArray[np.float32]) -> DepthImage:
    return DepthImage(depth_m, 1.0)


def place_in(
    boxes_xyxy: Boxes, depth: DepthImage, camera: Intrinsics, masks: Masks | None = None
) -> tuple[Placement, ...]:
    return place(surfaces_in(boxes_xyxy, depth, camera, masks), camera)


def placed(scene: DepthScene, masks: Masks | None = None) -> Placement:
    (placement,) = place_in(scene.box_xyxy[None], in_metres(scene.depth_m), scene.camera, masks)
    return placement


def error_of(scene: DepthScene, masks: Masks | None = None) -> float:
    """Distance of the found from the true centre in parts of the range; 1 for an object that is not found."""
    found = placed(scene, masks)
    if isinstance(found, Unplaced):
        return 1.0
    return math.dist(found.centre_xyz_m, scene.centre_xyz_m.tolist()) / scene.range_m


@cache
def centre_errors(difficulty: str, shapes: tuple[Shape, ...]) -> NDArray[np.float64]:
    """Errors of the centre in parts of the range."""
    rng = np.random.default_rng(14)
    scenes = [random_depth_scene(rng, shape, DIFFICULTIES[difficulty]) for shape in shapes * SCENES_PER_SHAPE]
    return np.array([error_of(scene) for scene in scenes])


@pytest.mark.long
@pytest.mark.parametrize("shapes", [SOLID, THIN], ids=["solid", "thin"])
@pytest.mark.parametrize("difficulty", DIFFICULTIES)
def test_the_median_error_of_the_centre_is_at_most_2_percent_of_the_range(
    difficulty: str, shapes: tuple[Shape, ...]
) -> None:
    assert np.median(centre_errors(difficulty, shapes)) <= 0.02


@cache
def floor_errors(kind: str, *, is_ideal: bool) -> NDArray[np.float64]:
    """The same for things on a floor, seen from above."""
    rng = np.random.default_rng(24)
    scenes = [random_floor_scene(rng, kind, is_ideal=is_ideal) for _ in range(SCENES_PER_SHAPE)]
    return np.array([error_of(scene) for scene in scenes])


@pytest.mark.parametrize("kind", KINDS)
def test_on_a_floor_the_median_error_of_the_centre_is_at_most_2_percent_of_the_range(kind: str) -> None:
    assert np.median(floor_errors(kind, is_ideal=True)) <= 0.02


@pytest.mark.long
def test_as_measured_the_median_error_on_a_floor_is_at_most_2_percent_of_the_range() -> None:
    assert np.median([floor_errors(kind, is_ideal=False) for kind in KINDS]) <= 0.02


def test_95_of_100_centres_of_solids_and_furniture_are_at_most_5_percent_of_the_range_away() -> None:
    assert np.quantile([floor_errors(kind, is_ideal=True) for kind in KINDS], 0.95) <= 0.05


def test_of_half_hidden_solids_between_walls_95_of_100_are_at_most_10_percent_of_the_range_away() -> None:
    rng = np.random.default_rng(24)
    scenes = [
        random_floor_scene(rng, kind, is_ideal=True, is_between_walls=True, is_half_hidden=True)
        for kind in ("cuboid", "cylinder", "person") * SCENES_PER_SHAPE
    ]
    assert np.quantile([error_of(scene) for scene in scenes], 0.95) <= 0.1


@pytest.mark.parametrize("lens", LENSES)
def test_through_a_lens_the_median_error_of_the_centre_is_at_most_2_percent_of_the_range(lens: str) -> None:
    rng = np.random.default_rng(24)
    scenes = [random_floor_scene(rng, kind, is_ideal=True, camera=LENSES[lens]) for kind in [*KINDS] * 4]
    assert np.median([error_of(scene) for scene in scenes]) <= 0.02


@pytest.mark.parametrize("aside_px", [0, 2], ids=["exact", "two pixels aside"])
def test_with_its_mask_95_of_100_thin_objects_in_a_row_are_at_most_3_percent_of_the_range_away(
    aside_px: int,
) -> None:
    rng = np.random.default_rng(14)
    in_a_row = Difficulty(hole_share=0.3, has_neighbours=True)
    scenes = [random_depth_scene(rng, shape, in_a_row) for shape in THIN * SCENES_PER_SHAPE]
    assert np.quantile([error_of(scene, scene.masks(aside_px)) for scene in scenes], 0.95) <= 0.03
    assert np.quantile([error_of(scene) for scene in scenes], 0.95) > 0.3, "which boxes do not tell"


@pytest.mark.parametrize("height_m", [0.8, 1.6])
@pytest.mark.parametrize("yaw", [0.0, 0.5], ids=["straight", "turned"])
def test_a_cuboid_on_a_floor_has_the_size_of_all_its_visible_faces(yaw: float, height_m: float) -> None:
    """Its far end, which only the top shows, counts, and the floor at its foot does not."""
    view = View(height_m, pitch=0.4, x_m=0.1, z_m=2.0, yaw=yaw)
    surface = rendered(view, (Cuboid((-0.25, 0, -0.4), (0.25, 0.5, 0.4)),))
    depth_m = np.minimum(surface, room(view, wall_m=3.0))
    seen = np.isfinite(surface)
    lower, upper = bounds(surface)
    box = np.array([tight_box(seen)], np.float32)
    (found,) = place_in(box, in_metres(np.asarray(depth_m, np.float32)), CAMERA)
    assert isinstance(found, Box3D)
    assert found.size_xyz_m == pytest.approx((upper - lower).tolist(), rel=0.2)
    assert found.centre_xyz_m == pytest.approx(((lower + upper) / 2).tolist(), abs=0.06)


def board_before_wall(board_m: float = 2.0) -> NDArray[np.float32]:
    depth_m = np.full(SIZE_HW, 4, np.float32)
    depth_m[80:140, 100:180] = board_m
    return depth_m


BOX: Boxes = np.array([[100, 80, 180, 140]], np.float32)


def test_a_board_has_the_centre_and_size_of_the_pinhole_camera() -> None:
    (box,) = place_in(BOX, in_metres(board_before_wall()), CAMERA)
    assert isinstance(box, Box3D)
    # The box's middle is 20 columns and 10 rows left of and above the principal point, between two pixels.
    assert box.centre_xyz_m == pytest.approx((-20 / 270 * 2, -10 / 270 * 2, 2.0), rel=1e-6)
    assert box.size_xyz_m == pytest.approx((80 / 270 * 2, 60 / 270 * 2, 0.0), abs=1e-6)
    assert box.distance_m == pytest.approx(math.hypot(20 / 135, 10 / 135, 2.0))


def test_a_few_pixels_that_differ_do_not_make_an_object_thicker() -> None:
    depth_m = board_before_wall()
    depth_m[100:104, 140:144] = 2.06
    (box,) = place_in(BOX, in_metres(depth_m), CAMERA)
    assert isinstance(box, Box3D)
    assert box.size_xyz_m[2] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_an_object_without_measurements_has_not_the_distance_of_what_is_behind_it(value: float) -> None:
    depth_m = board_before_wall(board_m=value)
    wider = BOX + np.array([-5, -5, 5, 5], np.float32)
    assert place_in(wider, in_metres(depth_m), CAMERA) == (Unplaced.NO_VALID_DEPTH,)


@pytest.mark.parametrize(
    "box",
    [
        pytest.param((50, 50, 52, 51), id="two pixels"),
        pytest.param((-100, -100, 400, 400), id="beyond every edge"),
        pytest.param((0, 0, 320, 240), id="the image"),
    ],
)
def test_an_unusual_box_has_the_distance_of_a_wall(box: tuple[float, ...]) -> None:
    (found,) = place_in(np.array([box], np.float32), in_metres(np.full(SIZE_HW, 3, np.float32)), CAMERA)
    assert isinstance(found, Box3D)
    assert found.centre_xyz_m[2] == pytest.approx(3.0)


def test_what_the_lens_cannot_see_has_no_place() -> None:
    camera = replace(CAMERA, fx=80.0, fy=80.0, distortion=Distortion("equidistant", (0.0,) * 4))
    boxes_xyxy = np.array([[120, 80, 200, 160], [0, 0, 12, 12]], np.float32)
    wall = in_metres(np.full(SIZE_HW, 3, np.float32))
    seen, unseen = place_in(boxes_xyxy, wall, camera)
    assert isinstance(seen, Box3D)
    assert unseen is Unplaced.NO_VALID_DEPTH


OTHER_SIZE = Intrinsics(CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, (480, 640))


@pytest.mark.parametrize(
    ("image_size_hw", "camera", "reason"),
    [
        pytest.param(SIZE_HW, None, Unplaced.NO_CAMERA_INFO, id="no camera_info"),
        pytest.param((480, 640), CAMERA, Unplaced.OTHER_SIZE, id="colour of another size"),
        pytest.param(SIZE_HW, OTHER_SIZE, Unplaced.OTHER_SIZE, id="camera_info of another size"),
    ],
)
def test_it_is_told_why_nothing_can_be_placed(
    image_size_hw: tuple[int, int], camera: Intrinsics | None, reason: Unplaced
) -> None:
    assert unusable(image_size_hw, in_metres(board_before_wall()), camera) == reason


boxes = st.tuples(*[st.floats(-50, 400, width=32)] * 4).map(
    lambda ends: (min(ends[0], ends[2]), min(ends[1], ends[3]), max(ends[0], ends[2]), max(ends[1], ends[3]))
)
several_boxes = st.lists(boxes, min_size=1, max_size=5).map(lambda rows: np.array(rows, np.float32))


@given(seed=st.integers(0, 5), boxes_xyxy=several_boxes)
@settings(max_examples=12)
def test_a_box_is_placed_alike_alone_and_among_others(seed: int, boxes_xyxy: Boxes) -> None:
    with_holes = Difficulty(hole_share=0.3)
    scene = random_depth_scene(np.random.default_rng(seed), SHAPES[seed % len(SHAPES)], with_holes)
    depth = DepthImage(np.rint(scene.depth_m * 1000).astype(np.uint16), 0.001)
    alone = [place_in(box[None], depth, CAMERA) for box in boxes_xyxy]
    assert place_in(boxes_xyxy, depth, CAMERA) == tuple(found for (found,) in alone)


@given(data=st.binary(min_size=0, max_size=64), boxes_xyxy=several_boxes)
@settings(max_examples=20)
def test_any_values_and_boxes_give_finite_numbers_or_a_reason(data: bytes, boxes_xyxy: Boxes) -> None:
    values = np.resize(np.frombuffer(data or b"\0", np.uint8), 320 * 240 * 4).view("<f4")
    depth = DepthImage(values.reshape(240, 320), 1.0)
    for found in place_in(boxes_xyxy, depth, CAMERA):
        if isinstance(found, Box3D):
            assert np.isfinite((found.centre_xyz_m, found.size_xyz_m)).all()
            assert min(found.size_xyz_m) >= 0


def test_each_of_many_boxes_has_its_own_mask() -> None:
    """All boxes are alike; one half shows something nearer, and every third mask has it."""
    depth_m = board_before_wall()
    depth_m[80:140, 100:140] = 1
    is_near = np.zeros(SIZE_HW, np.bool_)
    is_near[:, :140] = True
    prototypes = np.where(is_near, 9, -9).astype(np.float32)[None]
    coefficients = np.resize(np.array((1, -1, -1), np.float32), (2 * MAX_BOXES_AT_ONCE + 3, 1))
    boxes_xyxy = np.repeat(BOX, len(coefficients), axis=0)
    masks = Masks(prototypes, coefficients, SIZE_HW)
    found = place_in(boxes_xyxy, in_metres(depth_m), CAMERA, masks)
    depths_m = [one.centre_xyz_m[2] for one in found if isinstance(one, Box3D)]
    assert depths_m == pytest.approx(np.where(coefficients[:, 0] > 0, 1, 2).tolist())


def test_a_thousand_boxes_on_the_widest_image_are_placed() -> None:
    row = np.full(MAX_SIDE_PX, 2000, np.uint16)
    values = np.broadcast_to(row, (MAX_SIDE_PX, MAX_SIDE_PX))
    camera = Intrinsics(9000.0, 9000.0, 8191.5, 8191.5, values.shape)
    rng = np.random.default_rng(0)
    starts = rng.uniform(0, MAX_SIDE_PX / 2, (1000, 2))
    everywhere = np.concatenate((starts, starts + rng.uniform(0, MAX_SIDE_PX / 2, (1000, 2))), axis=1)
    found = place_in(everywhere.astype(np.float32), DepthImage(values, 0.001), camera)
    assert len(found) == 1000 > MAX_BOXES_AT_ONCE
    assert {round(one.centre_xyz_m[2], 5) for one in found if isinstance(one, Box3D)} == {2.0}
    assert not any(isinstance(one, Unplaced) for one in found)
