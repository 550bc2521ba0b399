"""The name of a coordinate frame in a message, which every detection repeats."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from yolov5_lifecycle.images.compressed import compressed_image, encode_jpeg
from yolov5_lifecycle.images.encodings import raw_image
from yolov5_lifecycle.images.image import MAX_FRAME_ID, ColourImage, ImageError
from yolov5_lifecycle.spatial.depth_image import depth_image_of_message
from yolov5_lifecycle.spatial.intrinsics import IntrinsicsError, intrinsics_of_message

JPEG = encode_jpeg(ColourImage(np.zeros((1, 1, 3), np.uint8), "rgb"))
READERS = [
    pytest.param(raw_image, {"encoding": "mono8", "data": b"\0", "step": 1}, id="raw"),
    pytest.param(compressed_image, {"format": "", "data": JPEG}, id="compressed"),
    pytest.param(depth_image_of_message, {"encoding": "16UC1", "data": b"\0\0", "step": 2}, id="depth"),
    pytest.param(intrinsics_of_message, {"k": [1.0] * 9, "p": [1.0] * 12}, id="camera_info"),
]


def message(frame_id: str, **fields: Any) -> SimpleNamespace:
    header = SimpleNamespace(frame_id=frame_id)
    return SimpleNamespace(header=header, height=1, width=1, is_bigendian=0, **fields)


@pytest.mark.parametrize("read", [reader.values[0] for reader in READERS])
def test_a_message_with_a_long_frame_id_is_refused_before_anything_else_is_read(
    read: Callable[[Any], object],
) -> None:
    header_alone = SimpleNamespace(header=SimpleNamespace(frame_id="x" * (MAX_FRAME_ID + 1)))
    expected = "Expected a frame_id of at most 256 characters, found 257. Correct it in the driver"
    with pytest.raises((ImageError, IntrinsicsError), match=expected):
        read(header_alone)


@pytest.mark.parametrize(("read", "fields"), READERS)
def test_a_frame_id_of_the_greatest_length_is_accepted(
    read: Callable[[Any], object], fields: dict[str, Any]
) -> None:
    header = SimpleNamespace(frame_id="x" * MAX_FRAME_ID)
    assert read(SimpleNamespace(header=header, height=1, width=1, is_bigendian=0, **fields))
