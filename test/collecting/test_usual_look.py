"""How unlike the usual an image of a camera looks."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.candidates import look_of

from yolov5_lifecycle.collecting.usual_look import MIN_IMAGES, UsualLook


def near(seed: int) -> NDArray[np.float32]:
    """A look of the camera's usual place."""
    return look_of(0) + np.float32(0.3) * look_of(seed)


@pytest.fixture
def usual() -> UsualLook:
    usual = UsualLook()
    for seed in range(1, 3 * MIN_IMAGES):
        usual.times_usual(near(seed), "model")
    return usual


def test_a_usual_image_is_about_as_far_from_the_mean_as_usual_and_another_is_much_farther(
    usual: UsualLook,
) -> None:
    assert 0.5 < usual.times_usual(near(1000), "model") < 2
    assert usual.times_usual(look_of(1000), "model") > 8


def test_what_was_unusual_becomes_usual(usual: UsualLook) -> None:
    times = [
        usual.times_usual(look_of(1) + np.float32(0.3) * look_of(seed), "model") for seed in range(2, 400)
    ]
    assert times[0] > 8
    assert times[-1] < 1.5


@pytest.mark.parametrize("model", ["another", "model"])
def test_until_some_images_of_a_model_are_known_none_is_unusual(usual: UsualLook, model: str) -> None:
    size = 32 if model == "model" else 64
    looks = [look_of(seed)[:size] for seed in range(MIN_IMAGES)]
    times = [usual.times_usual(look, model) for look in looks]
    assert times[:-1] == [0.0] * (MIN_IMAGES - 1)
    assert times[-1] > 0


@pytest.mark.parametrize("value", [0, np.nan, np.inf])
def test_an_embedding_without_direction_is_not_unusual_and_spoils_nothing(
    usual: UsualLook, value: float
) -> None:
    assert usual.times_usual(np.full(64, value, np.float32), "model") == 0
    assert usual.times_usual(look_of(1000), "model") > 8


def test_images_that_are_all_the_same_are_not_unusual() -> None:
    usual = UsualLook()
    assert {usual.times_usual(np.ones(4, np.float32), "model") for _ in range(100)} == {0.0}
