"""An image is what its type says, or is refused."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from yolov5_lifecycle.images.compressed import compressed_image, encode_jpeg
from yolov5_lifecycle.images.encodings import GreyImage, decode_raw, raw_image
from yolov5_lifecycle.images.image import MAX_FRAME_ID, ColourImage, ImageError, bytes_of
from yolov5_lifecycle.spatial.camera_model import intrinsics_of_message
from yolov5_lifecycle.spatial.depth_image import depth_image_of_message


@pytest.mark.parametrize(
    ("pixels", "told"),
    [
        pytest.param(None, "found NoneType", id="failed imread"),
        pytest.param(np.zeros((2, 2), np.uint8), r"found uint8 of shape \(2, 2\)", id="two axes"),
        pytest.param(np.zeros((2, 2, 4), np.uint8), r"found uint8 of shape \(2, 2, 4\)", id="four channels"),
        pytest.param(np.zeros((2, 2, 3)), "found float64", id="float"),
        pytest.param(np.zeros((0, 2, 3), np.uint8), "found 0 x 2", id="no rows"),
    ],
)
def test_an_image_of_other_pixels_is_refused(pixels: Any, told: str) -> None:
    with pytest.raises(ImageError, match=told):
        ColourImage(pixels, "rgb")


@pytest.mark.parametrize(
    "data",
    [
        pytest.param([1] * 12, id="list"),
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
    assert image.channel_order == "rgb"
    assert image.pixels.tolist() == [[[value] * 3 for value in row] for row in grey.tolist()]
    data[0] = 9
    assert grey[0, 0] == 9
    assert not grey.flags.writeable


JPEG = encode_jpeg(ColourImage(np.zeros((1, 1, 3), np.uint8), "rgb"))


@pytest.mark.parametrize(
    ("read", "fields"),
    [
        pytest.param(raw_image, {"encoding": "mono8", "data": b"\0", "step": 1}, id="raw"),
        pytest.param(compressed_image, {"format": "", "data": JPEG}, id="compressed"),
        pytest.param(depth_image_of_message, {"encoding": "16UC1", "data": b"\0\0", "step": 2}, id="depth"),
        pytest.param(
            partial(intrinsics_of_message, is_rectified=False),
            {"k": [1.0] * 9, "p": [1.0] * 12, "d": (), "distortion_model": ""},
            id="camera_info",
        ),
    ],
)
def test_a_message_with_a_long_frame_id_is_refused_before_anything_else_is_read(
    read: Callable[[Any], object], fields: dict[str, Any]
) -> None:
    header = SimpleNamespace(frame_id="x" * MAX_FRAME_ID)
    assert read(SimpleNamespace(header=header, height=1, width=1, is_bigendian=0, **fields))
    header.frame_id += "x"
    expected = "Expected a frame_id of at most 256 characters, found 257. Correct it in the driver"
    with pytest.raises(ImageError, match=expected):
        read(SimpleNamespace(header=header))
