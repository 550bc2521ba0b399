"""Label images say which shape each pixel of a scene belongs to."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from tools.shapes.random_shapes import random_shapes
from yolov5_lifecycle.sources.scene import CLASS_NAMES, Scene, Shape, label_image

SIZE_HW = (48, 64)


def _shape(class_name: str, centre_xy: tuple[float, float], radius: float, angle: float = 0.3) -> Shape:
    return Shape(CLASS_NAMES.index(class_name), centre_xy, radius, angle, (255, 255, 255))


def _labels(*shapes: Shape, size_hw: tuple[int, int] = SIZE_HW) -> NDArray[np.uint16]:
    return label_image([shape.outline() for shape in shapes], size_hw)


def _turns(outline: NDArray[np.float64], x: float, y: float) -> float:
    """How often `outline` goes round a point."""
    angles = np.arctan2(outline[:, 1] - y, outline[:, 0] - x)
    steps = np.diff(angles, append=angles[0])
    return float(np.sum((steps + math.pi) % (2 * math.pi) - math.pi) / (2 * math.pi))


def _slowly(shapes: list[Shape], size_hw: tuple[int, int]) -> NDArray[np.uint16]:
    labels = np.zeros(size_hw, np.uint16)
    for row, column in np.ndindex(*size_hw):
        for label, shape in enumerate(shapes, start=1):
            if abs(_turns(shape.outline(), column + 0.5, row + 0.5)) > 0.5:
                labels[row, column] = label
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
    shape = _shape(class_name, centre_xy, radius=17.3)
    labels = _labels(shape)
    assert labels.dtype == np.uint16
    np.testing.assert_array_equal(labels, _slowly([shape], SIZE_HW))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_scenes_are_labelled_like_pixel_by_pixel(seed: int) -> None:
    size_hw = (64, 80)
    _, shapes = random_shapes(np.random.default_rng(seed), size_hw)
    np.testing.assert_array_equal(_labels(*shapes, size_hw=size_hw), _slowly(shapes, size_hw))


def test_of_overlapping_shapes_the_later_one_is_visible() -> None:
    below, above = _shape("square", (25.0, 24.0), 15.0), _shape("circle", (35.0, 24.0), 10.0)
    labels = _labels(below, above)
    alone, covering = _labels(below) > 0, _labels(above) > 0
    assert (alone & covering).any()
    np.testing.assert_array_equal(labels == 2, covering)
    np.testing.assert_array_equal(labels == 1, alone & ~covering)


def test_a_shape_smaller_than_a_pixel_may_have_none() -> None:
    assert not _labels(_shape("circle", (20.0, 20.0), 0.2)).any()


@pytest.mark.parametrize("class_name", CLASS_NAMES)
def test_a_shape_has_the_area_of_its_outline(class_name: str) -> None:
    shape = _shape(class_name, (200.2, 200.7), radius=180.0)
    x, y = shape.outline().T
    area = abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2
    assert _labels(shape, size_hw=(400, 400)).sum() == pytest.approx(area, rel=0.005)


@pytest.mark.parametrize("index", [0, 50, 1000])
def test_the_pixels_of_a_moving_shape_fill_its_box(index: int) -> None:
    scene = Scene(4, (240, 320))
    _, truth = scene.frame(index)
    labels = _labels(*scene.shapes(index), size_hw=scene.size_hw)
    assert labels.max() == len(truth.class_ids)
    for label, box in enumerate(truth.boxes_xyxy, start=1):
        rows, columns = np.nonzero(labels == label)
        filled = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
        np.testing.assert_allclose(filled, box, atol=1.5)


@pytest.mark.parametrize("class_name", CLASS_NAMES)
def test_a_shape_is_drawn_where_its_pixels_are(class_name: str) -> None:
    shape = _shape(class_name, (50.25, 47.5), radius=30.0)
    pixels = np.zeros((100, 100, 3), np.uint8)
    shape.draw(pixels)
    is_shape = _labels(shape, size_hw=(100, 100)) > 0
    assert (pixels[is_shape] > 127).all()
    assert ((pixels[..., 0] > 127) & ~is_shape).sum() < 0.25 * is_shape.sum()
