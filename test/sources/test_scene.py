"""Scenes show what their ground truth says, the same each time."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tools.shapes.random_shapes import random_scene
from yolov5_lifecycle.sources.scene import CLASS_NAMES, SMALLEST_SIDE_PX, Scene, Shape, label_image
from yolov5_lifecycle.sources.scene_depth import DepthFrame, SceneDepth
from yolov5_lifecycle.spatial.camera_model import Intrinsics
from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.placement import Box3D, place
from yolov5_lifecycle.spatial.surface import surfaces_in


@pytest.mark.parametrize(
    "size_hw",
    [
        pytest.param((480, 640), id="vga"),
        pytest.param((320, 200), id="portrait"),
        pytest.param((SMALLEST_SIDE_PX, SMALLEST_SIDE_PX), id="smallest"),
    ],
)
@pytest.mark.parametrize("seed", range(5))
def test_shapes_of_every_class_move_in_the_image_and_never_overlap(
    seed: int, size_hw: tuple[int, int]
) -> None:
    scene = Scene(seed, size_hw)
    for index in (*range(0, 200, 20), 100_000):
        pixels, truth = scene.frame(index)
        assert pixels.shape == (*size_hw, 3)
        assert pixels.dtype == np.uint8
        boxes = truth.boxes_xyxy
        assert boxes.dtype == np.float32
        assert (boxes >= 0).all()
        assert (boxes <= (*size_hw[::-1], *size_hw[::-1])).all()
        upper = np.minimum(boxes[:, None, 2:], boxes[None, :, 2:])
        overlaps = (upper > np.maximum(boxes[:, None, :2], boxes[None, :, :2])).all(axis=2)
        np.testing.assert_array_equal(overlaps, np.eye(len(boxes), dtype=bool))
        assert set(truth.class_ids) == set(range(len(CLASS_NAMES)))


@pytest.mark.parametrize(
    "size_hw",
    [
        pytest.param((SMALLEST_SIDE_PX - 1, 640), id="low"),
        pytest.param((480, SMALLEST_SIDE_PX - 1), id="narrow"),
    ],
)
def test_an_image_too_small_for_shapes_is_refused(size_hw: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match="at least 64 pixels"):
        Scene(0, size_hw)
    with pytest.raises(ValueError, match="at least 64 pixels"):
        random_scene(np.random.default_rng(0), size_hw)


SIZE_HW = (48, 64)


def shape_of(class_name: str, centre_xy: tuple[float, float], radius: float) -> Shape:
    return Shape(CLASS_NAMES.index(class_name), centre_xy, radius, 0.3, (255, 255, 255))


def labels_of(*shapes: Shape, size_hw: tuple[int, int] = SIZE_HW) -> NDArray[np.uint16]:
    return label_image([shape.outline() for shape in shapes], size_hw)


def _slowly(shape: Shape, size_hw: tuple[int, int]) -> NDArray[np.uint16]:
    outline = shape.outline().astype(np.float32)
    labels = np.zeros(size_hw, np.uint16)
    for row, column in np.ndindex(*size_hw):
        labels[row, column] = cv2.pointPolygonTest(outline, (column + 0.5, row + 0.5), False) > 0
    return labels


@pytest.mark.long
@pytest.mark.parametrize(
    "centre_xy",
    [
        pytest.param((30.25, 23.5), id="inside"),
        pytest.param((1.0, 2.0), id="beyond the upper left corner"),
        pytest.param((62.5, 47.0), id="beyond the lower right corner"),
        pytest.param((-40.0, 20.0), id="outside"),
    ],
)
@pytest.mark.parametrize("class_name", CLASS_NAMES)
def test_the_pixels_of_a_shape_are_those_whose_centres_its_outline_encloses(
    class_name: str, centre_xy: tuple[float, float]
) -> None:
    shape = shape_of(class_name, centre_xy, radius=17.3)
    labels = labels_of(shape)
    assert labels.dtype == np.uint16
    np.testing.assert_array_equal(labels, _slowly(shape, SIZE_HW))


def test_of_overlapping_shapes_the_later_one_is_visible() -> None:
    below, above = shape_of("square", (25.0, 24.0), 15.0), shape_of("circle", (35.0, 24.0), 10.0)
    labels = labels_of(below, above)
    alone, covering = labels_of(below) > 0, labels_of(above) > 0
    assert (alone & covering).any()
    np.testing.assert_array_equal(labels == 2, covering)
    np.testing.assert_array_equal(labels == 1, alone & ~covering)


@pytest.mark.parametrize("class_name", CLASS_NAMES)
def test_a_shape_is_drawn_where_its_pixels_are(class_name: str) -> None:
    shape = shape_of(class_name, (50.25, 47.5), radius=30.0)
    pixels = np.zeros((100, 100, 3), np.uint8)
    shape.draw(pixels)
    is_shape = labels_of(shape, size_hw=(100, 100)) > 0
    assert (pixels[is_shape] > 127).all()
    assert ((pixels[..., 0] > 127) & ~is_shape).sum() < 0.25 * is_shape.sum()


class OneBehindTheOther(Scene):
    """Two squares in the same place, the first one twice as large in the image."""

    def shapes(self, index: int) -> list[Shape]:
        del index
        return [Shape(1, (60.0, 50.0), radius, 0.3, (255, 255, 255)) for radius in (40.0, 20.0)]


def intrinsics(frame: DepthFrame) -> Intrinsics:
    camera = frame.camera_info
    p = camera.projection_matrix.data
    return Intrinsics(p[0], p[5], p[2], p[6], camera.size_hw)


@pytest.mark.parametrize("size_hw", [(480, 640), (320, 200), (64, 64)], ids=str)
@pytest.mark.parametrize("seed", range(4))
def test_the_shapes_are_found_in_the_depth_image_where_they_are(seed: int, size_hw: tuple[int, int]) -> None:
    scene = Scene(seed, size_hw)
    space = SceneDepth(seed, scene)
    errors = []
    for index in (0, 50, 137):
        boxes, frame = scene.frame(index)[1].boxes_xyxy, space.frame(index)
        assert len(frame.centres_xyz_m) == len(frame.sizes_xyz_m) == len(boxes)
        camera = intrinsics(frame)
        placed = place(surfaces_in(boxes, DepthImage(frame.depth_mm, 0.001), camera), camera)
        for box, centre in zip(placed, frame.centres_xyz_m, strict=True):
            assert isinstance(box, Box3D)
            errors.append(float(np.linalg.norm(box.centre_xyz_m - centre) / np.linalg.norm(centre)))
    assert np.median(errors) < 0.01
    assert max(errors) < 0.02


def test_of_two_shapes_in_one_pixel_the_nearer_is_measured() -> None:
    scene = OneBehindTheOther(0, (100, 120))
    frame = SceneDepth(0, scene).frame(0)
    nearest_m = frame.centres_xyz_m[:, 2].min()
    assert np.ptp(frame.centres_xyz_m[:, 2]) > 1
    assert frame.depth_mm[49:51, 59:61] / 1000 == pytest.approx(nearest_m, rel=0.05)


def test_a_scene_and_its_depth_are_the_same_wherever_they_are_made() -> None:
    scene = Scene(5, (120, 160))
    space = SceneDepth(5, scene)
    (pixels, _), depth = scene.frame(11), space.frame(11)
    expected = pixels.copy(), depth.depth_mm.copy(), depth.centres_xyz_m.copy()
    assert (depth.depth_mm > 0).all()
    for of_caller in (pixels, depth.depth_mm, depth.centres_xyz_m):
        of_caller[:] = 0
    scene.frame(200)  # frames do not depend on those before
    fresh = Scene(5, (120, 160))
    for again, space_again in ((scene, space), (fresh, SceneDepth(5, fresh))):
        depth = space_again.frame(11)
        found = again.frame(11)[0], depth.depth_mm, depth.centres_xyz_m
        for one, other in zip(expected, found, strict=True):
            np.testing.assert_array_equal(one, other)
