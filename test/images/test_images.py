"""An image is what its type says, or is refused."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from yolov5_lifecycle.images.encodings import GreyImage, decode_raw
from yolov5_lifecycle.images.image import ColourImage, ImageError, bytes_of

BYTES = bytes(range(12))


@pytest.mark.parametrize(
    "pixels",
    [
        np.zeros((2, 2), np.uint8),
        np.zeros((2, 2, 4), np.uint8),
        np.zeros((2, 2, 3)),
        np.zeros((0, 2, 3), np.uint8),
    ],
    ids=["two axes", "four channels", "float", "no rows"],
)
def test_an_image_of_other_pixels_is_refused(pixels: NDArray[Any]) -> None:
    with pytest.raises(ImageError, match="found"):
        ColourImage(pixels, "rgb")


@pytest.mark.parametrize(
    "buffer",
    [
        pytest.param(bytes, id="bytes"),
        pytest.param(bytearray, id="bytearray"),
        pytest.param(memoryview, id="memoryview"),
        pytest.param(lambda data: array("B", data), id="array of bytes"),
        pytest.param(lambda data: array("H", data), id="array of words"),
        pytest.param(lambda data: np.frombuffer(data, np.uint8), id="ndarray"),
        pytest.param(lambda data: np.frombuffer(data, np.uint8).reshape(3, 4), id="matrix"),
    ],
)
def test_any_contiguous_buffer_is_viewed(buffer: Callable[[bytes], object]) -> None:
    assert bytes_of(buffer(BYTES)).tobytes() == BYTES


def test_an_empty_buffer_has_no_bytes() -> None:
    assert bytes_of(b"").size == 0


@pytest.mark.parametrize(
    "data",
    [
        pytest.param([1] * 12, id="list"),
        pytest.param("a" * 12, id="text"),
        pytest.param(None, id="nothing"),
        pytest.param(np.zeros((2, 12), np.uint8)[:, ::2], id="not contiguous"),
    ],
)
def test_what_is_no_contiguous_buffer_is_refused(data: object) -> None:
    with pytest.raises(ImageError, match=f"contiguous buffer of bytes, found {type(data).__name__}"):
        bytes_of(data)


def test_grey_pixels_are_a_view_of_the_message_until_their_colours_are_asked_for() -> None:
    data = bytearray(range(8))
    image = decode_raw(data, encoding="mono8", height=2, width=3, step=4, is_bigendian=False)
    assert isinstance(image, GreyImage)
    grey, order = image.as_sent
    assert order == "grey"
    assert grey.tolist() == [[0, 1, 2], [4, 5, 6]]
    assert image.size_hw == (2, 3)
    assert image.order == "rgb"
    assert image.pixels.tolist() == [[[value] * 3 for value in row] for row in grey.tolist()]
    data[0] = 9
    assert grey[0, 0] == 9
    assert not grey.flags.writeable


def test_an_image_of_colours_is_sent_as_it_is() -> None:
    pixels = np.zeros((2, 3, 3), np.uint8)
    sent, order = ColourImage(pixels, "bgr").as_sent
    assert sent is pixels
    assert order == "bgr"


def test_a_grey_image_without_pixels_is_refused() -> None:
    with pytest.raises(ImageError, match="found 0 x 2"):
        GreyImage(np.zeros((0, 2), np.uint8))
