"""The letterbox is YOLOv5's, and its two directions are each other's inverse."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from yolov5_lifecycle.detection.letterbox import PADDING_VALUE, Letterbox

sides = st.integers(1, 16384)
sizes_hw = st.tuples(sides, sides)
strides = st.sampled_from([32, 64])


def random_pixels(source_hw: tuple[int, int]) -> NDArray[np.uint8]:
    return np.random.default_rng(0).integers(0, 256, (*source_hw, 3), np.uint8)


@settings(deadline=None)
@given(source_hw=sizes_hw, stride=strides, steps=st.integers(1, 20))
def test_numbers_are_those_of_yolov5(source_hw: tuple[int, int], stride: int, steps: int) -> None:
    image_size = stride * steps
    letterbox = Letterbox.fit(source_hw, image_size=image_size, stride=stride)

    height, width = source_hw
    ratio = min(image_size / height, image_size / width)
    unpadded_w, unpadded_h = max(round(width * ratio), 1), max(round(height * ratio), 1)
    padding_w, padding_h = (image_size - unpadded_w) % stride, (image_size - unpadded_h) % stride
    assert letterbox.resized_hw == (unpadded_h, unpadded_w)
    assert (letterbox.left, letterbox.top) == (round(padding_w / 2 - 0.1), round(padding_h / 2 - 0.1))
    right = letterbox.network_hw[1] - letterbox.left - unpadded_w
    bottom = letterbox.network_hw[0] - letterbox.top - unpadded_h
    assert (right, bottom) == (round(padding_w / 2 + 0.1), round(padding_h / 2 + 0.1))


@settings(deadline=None)
@given(source_hw=sizes_hw, stride=strides, steps=st.integers(1, 20))
def test_a_square_that_the_image_is_fitted_into_is_the_one_of_its_longer_side(
    source_hw: tuple[int, int], stride: int, steps: int
) -> None:
    side = stride * steps
    square = Letterbox.fit(source_hw, image_size=side, stride=side)
    assert Letterbox.into(source_hw, (side, side)) == square


def test_the_tighter_side_decides_the_scale_of_an_image_that_is_fitted_into_a_rectangle() -> None:
    letterbox = Letterbox.into((100, 100), (64, 96))
    assert (letterbox.resized_hw, letterbox.top, letterbox.left) == ((64, 64), 0, 16)
    np.testing.assert_array_equal(letterbox.undo(np.array([[16, 0, 80, 64]], np.float32)), [[0, 0, 100, 100]])


@pytest.mark.parametrize("stride", [32, 320], ids=["rectangle", "square"])
@pytest.mark.parametrize(
    "source_hw", [(480, 640), (360, 639), (1080, 810), (64, 64), (1, 1), (1, 16384), (16384, 1), (7, 3)]
)
def test_pixels_are_resized_linearly_and_framed_in_grey(source_hw: tuple[int, int], stride: int) -> None:
    """Also those of a view that nobody may write into and whose rows are padded, as of a message."""
    pixels = random_pixels((source_hw[0], source_hw[1] + 10))[:, 5:-5]
    pixels.flags.writeable = False
    letterbox = Letterbox.fit(source_hw, image_size=320, stride=stride)
    (height, width), (frame_height, frame_width) = letterbox.resized_hw, letterbox.network_hw
    expected = cv2.copyMakeBorder(
        cv2.resize(pixels.copy(), (width, height), interpolation=cv2.INTER_LINEAR),
        letterbox.top,
        frame_height - letterbox.top - height,
        letterbox.left,
        frame_width - letterbox.left - width,
        cv2.BORDER_CONSTANT,
        value=(PADDING_VALUE,) * 3,
    )
    np.testing.assert_array_equal(letterbox.apply(pixels), expected)


@settings(deadline=None)
@given(source_hw=sizes_hw, stride=strides, data=st.data())
def test_undo_is_the_inverse_of_the_way_pixels_go(
    source_hw: tuple[int, int], stride: int, data: st.DataObject
) -> None:
    letterbox = Letterbox.fit(source_hw, image_size=640, stride=stride)
    height, width = source_hw
    xs, ys = (sorted(data.draw(st.tuples(*[st.floats(0, side)] * 2))) for side in (width, height))
    source = np.array([[xs[0], ys[0], xs[1], ys[1]]])
    scale_x, scale_y = letterbox.resized_hw[1] / width, letterbox.resized_hw[0] / height
    origin = np.array([letterbox.left, letterbox.top] * 2)
    network = source * (scale_x, scale_y, scale_x, scale_y) + origin
    undone = letterbox.undo(network.astype(np.float32))
    assert undone.dtype == np.float32
    # float32 places 640 to 3e-5 network pixels.
    np.testing.assert_allclose(undone, source, atol=1e-4 / min(scale_x, scale_y) + 1e-3)
