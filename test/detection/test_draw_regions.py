"""Regions in an annotated image can be seen on any ground, and nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from yolov5_lifecycle.detection.box_filter import BoxFilter
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.draw import annotate
from yolov5_lifecycle.detection.draw_regions import IGNORED_BRIGHTNESS
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.images.region import Region

SIDE = 240
MIDDLE = Region.parse("0.25,0.25 0.75,0.25 0.75,0.75 0.25,0.75")
WHOLE = Region.parse("0,0 1,0 1,1 0,1")
NONE = Detections(np.empty((0, 4), np.float32), np.empty(0, np.float32), np.empty(0, np.int64))


def plain(level: int, height: int = SIDE, width: int = SIDE) -> ColourImage:
    return ColourImage(np.full((height, width, 3), level, np.uint8), "bgr")


def drawn(image: ColourImage, box_filter: BoxFilter) -> NDArray[np.uint8]:
    return annotate(image, NONE, ("cat",), box_filter=box_filter)


@pytest.mark.parametrize(
    "box_filter", [BoxFilter(), BoxFilter(min_box_size=9.0, region_anchor="foot")], ids=["none", "sizes"]
)
def test_without_regions_nothing_is_drawn(box_filter: BoxFilter) -> None:
    image = plain(77)
    np.testing.assert_array_equal(drawn(image, box_filter), image.pixels)


@pytest.mark.parametrize("level", [0, 114, 255])
def test_the_outline_of_a_region_is_visible_on_any_ground_and_faint(level: int) -> None:
    pixels = drawn(plain(level), BoxFilter(regions=(MIDDLE,))).astype(int)
    rows, columns = np.nonzero((pixels != level).any(axis=2))
    assert (rows.min(), columns.min()) == pytest.approx((SIDE / 4, SIDE / 4), abs=3)
    assert (rows.max(), columns.max()) == pytest.approx((SIDE * 3 / 4, SIDE * 3 / 4), abs=3)
    assert 40 < np.abs(pixels - level).max() <= 128
    inside = pixels[SIDE // 3 : 2 * SIDE // 3, SIDE // 3 : 2 * SIDE // 3]
    assert (inside == level).all()


def test_an_ignored_region_is_dark_and_hatched() -> None:
    pixels = drawn(plain(200), BoxFilter(ignore_regions=(MIDDLE,))).astype(int)
    inside = pixels[SIDE // 3 : 2 * SIDE // 3, SIDE // 3 : 2 * SIDE // 3]
    assert np.median(inside) == pytest.approx(200 * IGNORED_BRIGHTNESS, abs=1)
    assert inside.max() > 140
    assert (pixels[: SIDE // 5] == 200).all()


@pytest.mark.parametrize("size_hw", [(1, 1), (2, 300), (300, 2), (1080, 1920)], ids=str)
def test_a_region_of_the_whole_image_fits_any_image(size_hw: tuple[int, int]) -> None:
    image = plain(114, *size_hw)
    both = BoxFilter(regions=(WHOLE,), ignore_regions=(MIDDLE,))
    pixels = drawn(image, both)
    assert pixels.shape == (*size_hw, 3)
    assert (pixels != image.pixels).any()
    np.testing.assert_array_equal(image.pixels, 114)
