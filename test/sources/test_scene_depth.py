"""The depth of a scene agrees with its image and with its ground truth."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from yolov5_lifecycle.sources.frames import SourceError
from yolov5_lifecycle.sources.scene import Scene, Shape
from yolov5_lifecycle.sources.scene_depth import DepthFrame, SceneDepth
from yolov5_lifecycle.sources.source import open_source
from yolov5_lifecycle.spatial.depth_image import DepthImage
from yolov5_lifecycle.spatial.intrinsics import Intrinsics, intrinsics_of
from yolov5_lifecycle.spatial.placement import Box3D, place

SIZES_HW = [
    pytest.param((480, 640), id="vga"),
    pytest.param((320, 200), id="portrait"),
    pytest.param((64, 64), id="smallest"),
]


class OneBehindTheOther(Scene):
    """Two squares in the same place, the first one twice as large in the image."""

    def shapes(self, index: int) -> list[Shape]:
        del index
        return [Shape(1, (60.0, 50.0), radius, 0.3, (255, 255, 255)) for radius in (40.0, 20.0)]


def intrinsics(frame: DepthFrame) -> Intrinsics:
    camera = frame.camera_info
    return intrinsics_of(camera.camera_matrix.data, camera.projection_matrix.data, camera.size_hw)


@pytest.mark.parametrize("size_hw", SIZES_HW)
@pytest.mark.parametrize("seed", range(4))
def test_the_shapes_are_found_in_the_depth_image_where_they_are(seed: int, size_hw: tuple[int, int]) -> None:
    scene = Scene(seed, size_hw)
    space = SceneDepth(seed, scene)
    errors = []
    for index in (0, 50, 137):
        boxes, frame = scene.frame(index)[1].boxes_xyxy, space.frame(index)
        assert len(frame.centres_xyz_m) == len(frame.sizes_xyz_m) == len(boxes)
        placed = place(boxes, size_hw, DepthImage(frame.depth_mm, 0.001), intrinsics(frame))
        for box, centre in zip(placed, frame.centres_xyz_m, strict=True):
            assert isinstance(box, Box3D)
            errors.append(float(np.linalg.norm(box.centre_xyz_m - centre) / np.linalg.norm(centre)))
    assert np.median(errors) < 0.01
    assert max(errors) < 0.02


@pytest.mark.parametrize("seed", range(10))
def test_every_pixel_is_measured_and_every_shape_is_before_the_wall(seed: int) -> None:
    scene = Scene(seed, (240, 320))
    space = SceneDepth(seed, scene)
    shapes_are_at = np.zeros((240, 320), np.bool_)
    for index in (0, 77):
        frame = space.frame(index)
        for (x1, y1, x2, y2), centre in zip(
            scene.frame(index)[1].boxes_xyxy.tolist(), frame.centres_xyz_m, strict=True
        ):
            shapes_are_at[max(int(y1) - 1, 0) : int(y2) + 2, max(int(x1) - 1, 0) : int(x2) + 2] = True
            assert 0.9 < centre[2] < 4.3
        on_shapes = frame.depth_mm < 4500
        assert on_shapes.any()
        assert not (on_shapes & ~shapes_are_at).any()
        assert frame.depth_mm.min() > 800


def test_a_shape_that_grows_in_the_image_comes_nearer() -> None:
    scene = Scene(3, (480, 640))
    space = SceneDepth(3, scene)
    radii = np.array([[shape.radius for shape in scene.shapes(index)] for index in range(0, 120, 10)])
    distances = np.array([space.frame(index).centres_xyz_m[:, 2] for index in range(0, 120, 10)])
    real = radii * distances
    assert np.allclose(real, real.mean(axis=0), rtol=0.03)
    assert (np.ptp(distances, axis=0) > 0.02).all()


def test_of_two_shapes_in_one_pixel_the_nearer_is_measured() -> None:
    scene = OneBehindTheOther(0, (100, 120))
    frame = SceneDepth(0, scene).frame(0)
    nearest_m = frame.centres_xyz_m[:, 2].min()
    assert np.ptp(frame.centres_xyz_m[:, 2]) > 1
    assert frame.depth_mm[49:51, 59:61] / 1000 == pytest.approx(nearest_m, rel=0.05)


def test_depth_changes_neither_image_nor_ground_truth() -> None:
    sources = [open_source("synthetic", size_hw=(120, 160), seed=7, depth=depth) for depth in (False, True)]
    for plain, deep in itertools.islice(zip(*(source.frames for source in sources), strict=True), 5):
        assert plain.depth is None
        assert deep.depth is not None
        assert plain.truth is not None
        assert deep.truth is not None
        np.testing.assert_array_equal(plain.image.pixels, deep.image.pixels)
        np.testing.assert_array_equal(plain.truth.boxes_xyxy, deep.truth.boxes_xyxy)


def test_depth_is_the_same_wherever_it_is_made() -> None:
    scene = Scene(5, (120, 160))
    space = SceneDepth(5, scene)
    frame = space.frame(11)
    frame.depth_mm[:] = 0  # a frame belongs to the caller
    frame.centres_xyz_m[:] = 0
    again, same = space.frame(11), SceneDepth(5, Scene(5, (120, 160))).frame(11)
    np.testing.assert_array_equal(again.depth_mm, same.depth_mm)
    np.testing.assert_array_equal(again.centres_xyz_m, same.centres_xyz_m)
    assert (again.depth_mm > 0).all()


def test_a_source_without_depth_is_refused() -> None:
    with pytest.raises(SourceError, match=r"Only the source 'synthetic' has depth, not 'video\.mp4'"):
        open_source("video.mp4", depth=True)
