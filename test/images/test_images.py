"""An image is what its type says, or is refused."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

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
