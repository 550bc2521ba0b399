"""Scenes show what their ground truth says, the same each time."""

from __future__ import annotations

import numpy as np
import pytest

from tools.shapes.random_shapes import random_scene
from yolov5_lifecycle.sources.scene import CLASS_NAMES, SMALLEST_SIDE_PX, Scene, Shape, Truth

SIZES_HW = [
    pytest.param((480, 640), id="vga"),
    pytest.param((256, 320), id="small"),
    pytest.param((320, 200), id="portrait"),
    pytest.param((SMALLEST_SIDE_PX, SMALLEST_SIDE_PX), id="smallest"),
]


def _shape(class_name: str, *, angle: float = 0.3, radius: float = 30.0) -> Shape:
    return Shape(CLASS_NAMES.index(class_name), (50.25, 47.5), radius, angle, (255, 255, 255))


def _assert_within(truth: Truth, size_hw: tuple[int, int]) -> None:
    boxes = truth.boxes_xyxy
    assert boxes.dtype == np.float32
    assert boxes.shape == (len(truth.class_ids), 4)
    assert (boxes >= 0).all()
    assert (boxes <= (*size_hw[::-1], *size_hw[::-1])).all()
    assert (boxes[:, :2] < boxes[:, 2:]).all()
    assert np.isin(truth.class_ids, range(len(CLASS_NAMES))).all()


@pytest.mark.parametrize("size_hw", SIZES_HW)
@pytest.mark.parametrize("seed", range(5))
def test_the_truth_of_a_still_lies_inside_the_image(seed: int, size_hw: tuple[int, int]) -> None:
    pixels, truth = random_scene(np.random.default_rng(seed), size_hw)
    assert pixels.shape == (*size_hw, 3)
    assert pixels.dtype == np.uint8
    _assert_within(truth, size_hw)


@pytest.mark.parametrize("size_hw", SIZES_HW)
@pytest.mark.parametrize("index", [0, 1, 37, 100_000])
def test_the_truth_of_a_frame_lies_inside_the_image(index: int, size_hw: tuple[int, int]) -> None:
    pixels, truth = Scene(3, size_hw).frame(index)
    assert pixels.shape == (*size_hw, 3)
    assert pixels.dtype == np.uint8
    _assert_within(truth, size_hw)


@pytest.mark.parametrize("seed", range(10))
def test_a_moving_scene_always_shows_every_class(seed: int) -> None:
    _, truth = Scene(seed, (240, 320)).frame(0)
    assert set(truth.class_ids) == set(range(len(CLASS_NAMES)))


def test_stills_show_every_class_and_sometimes_nothing() -> None:
    rng = np.random.default_rng(0)
    truths = [random_scene(rng, (128, 128))[1] for _ in range(100)]
    assert set(np.concatenate([truth.class_ids for truth in truths])) == set(range(len(CLASS_NAMES)))
    assert any(len(truth.class_ids) == 0 for truth in truths)


def test_a_scene_is_the_same_wherever_it_is_made() -> None:
    pixels, truth = Scene(5, (240, 320)).frame(11)
    again = Scene(5, (240, 320))
    again.frame(200)  # frames do not depend on those before
    same_pixels, same_truth = again.frame(11)
    np.testing.assert_array_equal(pixels, same_pixels)
    np.testing.assert_array_equal(truth.boxes_xyxy, same_truth.boxes_xyxy)
    np.testing.assert_array_equal(truth.class_ids, same_truth.class_ids)


def test_other_seeds_give_other_scenes() -> None:
    assert (Scene(5, (240, 320)).frame(0)[0] != Scene(6, (240, 320)).frame(0)[0]).mean() > 0.5


def test_stills_of_the_same_generator_state_are_the_same() -> None:
    pixels, truth = random_scene(np.random.default_rng(4), (240, 320))
    same_pixels, same_truth = random_scene(np.random.default_rng(4), (240, 320))
    np.testing.assert_array_equal(pixels, same_pixels)
    np.testing.assert_array_equal(truth.boxes_xyxy, same_truth.boxes_xyxy)


def test_a_frame_belongs_to_the_caller() -> None:
    scene = Scene(5, (240, 320))
    pixels, _ = scene.frame(0)
    untouched = pixels.copy()
    pixels[:] = 0
    np.testing.assert_array_equal(scene.frame(0)[0], untouched)


@pytest.mark.parametrize("seed", range(5))
def test_shapes_move_a_little_from_frame_to_frame_and_far_in_the_end(seed: int) -> None:
    scene = Scene(seed, (480, 640))
    boxes = np.stack([scene.frame(index)[1].boxes_xyxy for index in range(120)])
    centres = (boxes[:, :, :2] + boxes[:, :, 2:]) / 2
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=2)
    assert (steps < 12).all()
    assert (np.ptp(centres, axis=0).max(axis=1) > 20).all()


@pytest.mark.parametrize("seed", range(5))
def test_moving_shapes_never_overlap(seed: int) -> None:
    scene = Scene(seed, (480, 640))
    for index in range(0, 200, 20):
        boxes = scene.frame(index)[1].boxes_xyxy
        shared = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:]) - np.maximum(
            boxes[:, None, :2], boxes[None, :, :2]
        )
        overlaps = (shared > 0).all(axis=2)
        np.testing.assert_array_equal(overlaps, np.eye(len(boxes), dtype=bool))


@pytest.mark.parametrize("index", [0, 50])
def test_only_what_is_in_the_boxes_moves(index: int) -> None:
    scene = Scene(8, (240, 320))
    pixels, truth = scene.frame(index)
    later_pixels, later_truth = scene.frame(index + 40)
    changed = (pixels != later_pixels).any(axis=2)
    for x1, y1, x2, y2 in np.concatenate((truth.boxes_xyxy, later_truth.boxes_xyxy)).tolist():
        changed[max(int(y1) - 3, 0) : int(y2) + 4, max(int(x1) - 3, 0) : int(x2) + 4] = False
    assert not changed.any()


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0, 5.0])
@pytest.mark.parametrize("class_name", CLASS_NAMES)
def test_the_pixels_of_a_shape_fill_its_box(class_name: str, angle: float) -> None:
    shape = _shape(class_name, angle=angle)
    pixels = np.zeros((100, 100, 3), np.uint8)
    shape.draw(pixels)
    rows, columns = np.nonzero(pixels[..., 0] > 127)
    drawn = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    outline = shape.outline()
    np.testing.assert_allclose(drawn, (*outline.min(axis=0), *outline.max(axis=0)), atol=1.5)


@pytest.mark.parametrize(
    ("class_name", "area"),
    [
        pytest.param("circle", np.pi, id="circle"),
        pytest.param("square", 2.0, id="square"),
        pytest.param("triangle", 3 * np.sqrt(3) / 4, id="triangle"),
        pytest.param("star", 10 * 0.5 * 0.42 * np.sin(np.pi / 5), id="star"),
    ],
)
def test_a_shape_has_the_area_of_its_figure_and_of_its_smooth_edge(class_name: str, area: float) -> None:
    pixels = np.zeros((100, 100, 3), np.uint8)
    shape = _shape(class_name, radius=40)
    shape.draw(pixels)
    outline = shape.outline()
    perimeter = np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1).sum()
    drawn = (pixels[..., 0] / 255).sum()
    assert 0 < drawn - area * 40**2 < 0.8 * perimeter


def test_a_shape_across_the_edge_is_boxed_by_what_is_visible() -> None:
    rng = np.random.default_rng(0)
    size_hw = (128, 128)
    boxes = np.concatenate([random_scene(rng, size_hw)[1].boxes_xyxy for _ in range(50)])
    at_the_edge = (boxes == 0).any(axis=1) | (boxes == 128).any(axis=1)
    assert at_the_edge.any()
    sides = boxes[at_the_edge, 2:] - boxes[at_the_edge, :2]
    assert (sides > 2).all()


@pytest.mark.parametrize(
    "size_hw",
    [
        pytest.param((SMALLEST_SIDE_PX - 1, 640), id="low"),
        pytest.param((480, SMALLEST_SIDE_PX - 1), id="narrow"),
        pytest.param((0, 0), id="empty"),
        pytest.param((-480, 640), id="negative"),
    ],
)
def test_an_image_too_small_for_shapes_is_refused(size_hw: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="at least 64 pixels"):
        Scene(0, size_hw)
    with pytest.raises(ValueError, match="at least 64 pixels"):
        random_scene(np.random.default_rng(0), size_hw)
