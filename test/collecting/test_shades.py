"""Whether two images show the same, as a person would say."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from yolov5_lifecycle.collecting.shades import SHADES, same_shades, shades_of
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.sources.scene import Scene

SIZES_HW = [(240, 320), (720, 1280), (2160, 3840)]
Pixels = NDArray[np.uint8]


def shot(size_hw: tuple[int, int], index: int = 0) -> Pixels:
    return Scene(3, size_hw).frame(index)[0]


def same(one: Pixels, other: Pixels) -> bool:
    first, second = (shades_of(ColourImage(pixels, "rgb")) for pixels in (one, other))
    return bool(same_shades(first, second[None])[0])


def noisy(pixels: Pixels) -> Pixels:
    noise = np.random.default_rng(0).normal(0, 5, pixels.shape)
    return np.clip(pixels + noise, 0, 255).astype(np.uint8)


def compressed(pixels: Pixels) -> Pixels:
    file = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 30])[1]
    return np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR), np.uint8)


def darker(pixels: Pixels, light: float = 0.4) -> Pixels:
    return (pixels * light).astype(np.uint8)


def shifted(pixels: Pixels) -> Pixels:
    """As by a camera that sways by 0.5 % of the image's height."""
    by = pixels.shape[0] // 200
    bordered = cv2.copyMakeBorder(pixels, by, 0, by, 0, cv2.BORDER_REPLICATE)
    return np.asarray(bordered[:-by, :-by], np.uint8)


@pytest.mark.long
@pytest.mark.parametrize("change", [noisy, compressed, darker, shifted])
@pytest.mark.parametrize("size_hw", SIZES_HW, ids=str)
def test_an_image_taken_again_is_the_same(
    size_hw: tuple[int, int], change: Callable[[Pixels], Pixels]
) -> None:
    assert same(shot(size_hw), change(shot(size_hw)))


@pytest.mark.long
@pytest.mark.parametrize("size_hw", SIZES_HW, ids=str)
def test_an_image_in_which_objects_moved_is_another_even_at_night(size_hw: tuple[int, int]) -> None:
    assert not same(shot(size_hw), shot(size_hw, 30))
    night, later = (noisy(darker(shot(size_hw, index), 0.06)) for index in (0, 30))
    assert not same(night, later)


def test_an_image_of_one_colour_is_like_every_other_of_one() -> None:
    black, white = np.zeros((48, 64, 3), np.uint8), np.full((1, 5000, 3), 255, np.uint8)
    assert shades_of(ColourImage(black, "bgr")).shape == (SHADES,)
    assert same(black, white)
