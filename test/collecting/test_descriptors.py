"""How much an image looks like others: kept ones, usual ones, and itself taken again."""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.candidates import look_of

from yolov5_lifecycle.collecting.descriptors import (
    MIN_IMAGES,
    MIN_ROWS,
    SHADES,
    KeptDescriptors,
    Shades,
    UsualDescriptor,
    same_shades,
    shades_of,
    unit,
)
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.sources.scene import Scene

SIZES_HW = [(240, 320), (2160, 3840)]
Pixels = NDArray[np.uint8]


def unit_of(seed: int) -> NDArray[np.float32]:
    direction = unit(look_of(seed))
    assert direction is not None
    return direction


def shades(seed: int) -> Shades:
    return np.random.default_rng(seed).integers(-64, 64, SHADES).astype(np.int8)


def test_the_distance_is_that_of_the_nearest_after_many_were_added_and_removed() -> None:
    kept = KeptDescriptors()
    count = 2 * MIN_ROWS + 2
    for seed in range(count):
        kept.add(f"{seed}", unit_of(seed), shades(seed))
    assert kept.distance(5 * look_of(3)) == pytest.approx(0, abs=1e-5)
    for seed in range(1, count, 2):
        kept.remove(f"{seed}")
    nearest = max(float(unit_of(seed) @ unit_of(3)) for seed in range(0, count, 2))
    assert kept.distance(look_of(3)) == pytest.approx(1 - nearest, abs=1e-5)
    for seed in range(0, count, 64):
        assert kept.is_duplicate(look_of(seed), shades(seed))
        assert not kept.is_duplicate(look_of(seed), shades(seed + 1))
    assert not kept.is_duplicate(look_of(3), shades(3))


def test_without_any_and_of_another_model_an_image_is_infinitely_far() -> None:
    kept = KeptDescriptors()
    assert kept.distance(look_of(0)) == math.inf
    kept.add("other", np.ones(3, np.float32), shades(0))
    kept.add("empty", np.empty(0, np.float32), shades(0))
    for embedding in (look_of(0), np.zeros(3, np.float32), np.empty(0, np.float32)):
        assert kept.distance(embedding) == math.inf
        assert not kept.is_duplicate(embedding, shades(0))


def near(seed: int) -> NDArray[np.float32]:
    """A look of the camera's usual place."""
    return look_of(0) + np.float32(0.3) * look_of(seed)


@pytest.fixture
def usual() -> UsualDescriptor:
    usual = UsualDescriptor()
    for seed in range(1, 3 * MIN_IMAGES):
        usual.times_usual(near(seed), "model")
    return usual


def test_a_usual_image_is_about_as_far_from_the_mean_as_usual_and_another_is_much_farther(
    usual: UsualDescriptor,
) -> None:
    assert 0.5 < usual.times_usual(near(1000), "model") < 2
    assert usual.times_usual(look_of(1000), "model") > 8


def test_what_was_unusual_becomes_usual(usual: UsualDescriptor) -> None:
    times = [
        usual.times_usual(look_of(1) + np.float32(0.3) * look_of(seed), "model") for seed in range(2, 400)
    ]
    assert times[0] > 8
    assert times[-1] < 1.5


@pytest.mark.parametrize("model", ["another", "model"])
def test_until_some_images_of_a_model_are_known_none_is_unusual(usual: UsualDescriptor, model: str) -> None:
    size = 32 if model == "model" else 64
    looks = [look_of(seed)[:size] for seed in range(MIN_IMAGES)]
    times = [usual.times_usual(look, model) for look in looks]
    assert times[:-1] == [0.0] * (MIN_IMAGES - 1)
    assert times[-1] > 0


@pytest.mark.parametrize("value", [0, np.nan, np.inf])
def test_an_embedding_without_direction_is_not_unusual_and_spoils_nothing(
    usual: UsualDescriptor, value: float
) -> None:
    assert usual.times_usual(np.full(64, value, np.float32), "model") == 0
    assert usual.times_usual(look_of(1000), "model") > 8


def test_images_that_are_all_the_same_are_not_unusual() -> None:
    usual = UsualDescriptor()
    assert {usual.times_usual(np.ones(4, np.float32), "model") for _ in range(100)} == {0.0}


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
