"""How a camera moved, found in two images: shifts, turns, nothing to follow, and images of any size."""

from __future__ import annotations

import math
import tracemalloc

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import MAX_SIDE_PX, ColourImage
from yolov5_lifecycle.sources.scene import cluttered_background
from yolov5_lifecycle.tracking.camera_motion import CameraMotion
from yolov5_lifecycle.tracking.motion import Similarity

SIZE_HW = (480, 640)
NO_BOXES = np.zeros((0, 4), np.float32)
BACKGROUND = cluttered_background(np.random.default_rng(3), SIZE_HW)


def moved_by(matrix: Similarity) -> ColourImage:
    pixels = cv2.warpAffine(BACKGROUND, matrix, SIZE_HW[::-1], borderMode=cv2.BORDER_REFLECT_101)
    return ColourImage(np.asarray(pixels, np.uint8), "bgr")


def similarity(x: float = 0, y: float = 0, degrees: float = 0, zoom: float = 1) -> Similarity:
    matrix = cv2.getRotationMatrix2D((320, 240), degrees, zoom)
    matrix[:, 2] += (x, y)
    return np.asarray(matrix, np.float64)


def found(*images: ColourImage, boxes_xyxy: NDArray[np.float32] = NO_BOXES) -> list[Similarity | None]:
    """What is found in each of `images` but the first."""
    camera = CameraMotion()
    return [camera.since_last(image, boxes_xyxy) for image in images][1:]


@pytest.mark.parametrize(
    "matrix",
    [
        pytest.param(similarity(12, -7), id="shift"),
        pytest.param(similarity(degrees=4), id="roll"),
        pytest.param(similarity(3, 2, degrees=-2, zoom=1.05), id="drive"),
    ],
)
def test_the_motion_of_the_camera_is_found(matrix: Similarity) -> None:
    (camera,) = found(moved_by(similarity()), moved_by(matrix))
    assert camera is not None
    places = np.array(((40, 40, 1), (600, 40, 1), (320, 240, 1), (40, 440, 1), (600, 440, 1.0)))
    np.testing.assert_allclose(places @ camera.T, places @ matrix.T, atol=2.5)


def test_a_camera_that_stands_still_moves_nothing() -> None:
    rng = np.random.default_rng(4)
    noise = (rng.normal(0, 2, BACKGROUND.shape) for _ in range(4))
    noisy = [ColourImage(np.clip(BACKGROUND + each, 0, 255).astype(np.uint8), "rgb") for each in noise]
    assert found(*noisy) == [None] * 3


def test_an_object_that_moves_before_a_still_camera_is_no_motion_of_the_camera() -> None:
    thing = cluttered_background(np.random.default_rng(5), (200, 160))
    images = []
    for x in (100, 112, 124):
        pixels = BACKGROUND.copy()
        pixels[100:300, x : x + 160] = thing
        images.append(ColourImage(pixels, "rgb"))
    assert found(*images) == [None] * 2


def test_what_is_in_a_box_is_not_followed() -> None:
    """An object that fills most of the image, before a background that stands still."""
    thing = np.random.default_rng(5).integers(0, 255, (40, 48, 3), np.uint8).repeat(10, 0).repeat(10, 1)
    images = []
    for x in (60, 72):
        pixels = BACKGROUND.copy()
        pixels[40:440, x : x + 480] = thing
        images.append(ColourImage(pixels, "rgb"))
    boxes = np.array([[60, 40, 540, 440]], np.float32)
    assert found(*images, boxes_xyxy=boxes) == [None]


@pytest.mark.parametrize(
    "pixels",
    [
        pytest.param(np.full((480, 640, 3), 114, np.uint8), id="plain grey"),
        pytest.param(np.zeros((1, 1, 3), np.uint8), id="one pixel"),
        pytest.param(np.zeros((MAX_SIDE_PX, 2, 3), np.uint8), id="two columns"),
    ],
)
def test_an_image_without_anything_to_follow_has_no_motion(pixels: NDArray[np.uint8]) -> None:
    assert found(*[ColourImage(pixels, "rgb")] * 3) == [None] * 2


def test_an_image_of_another_size_starts_afresh() -> None:
    small = ColourImage(np.ascontiguousarray(BACKGROUND[:240, :400]), "rgb")
    assert found(moved_by(similarity()), small, moved_by(similarity(9, 9))) == [None] * 2


def test_after_a_reset_the_last_image_is_forgotten() -> None:
    camera = CameraMotion()
    camera.since_last(moved_by(similarity()), NO_BOXES)
    camera.reset()
    camera.reset()
    assert camera.since_last(moved_by(similarity(20, 0)), NO_BOXES) is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
def test_boxes_that_are_no_places_are_ignored(value: float) -> None:
    boxes = np.full((3, 4), value, np.float32)
    with np.errstate(all="ignore"):
        found(moved_by(similarity()), moved_by(similarity(12, 0)), boxes_xyxy=boxes)


def test_of_a_large_image_few_pixels_are_copied() -> None:
    large = ColourImage(np.broadcast_to(BACKGROUND[:1, :1], (8000, 8000, 3)), "rgb")
    tracemalloc.start()
    try:
        CameraMotion().since_last(large, NO_BOXES)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 4 << 20  # the image has 192 MB
