"""Small images as compressed files."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray


def image_file(suffix: str, values: NDArray[Any], *flags: int) -> bytes:
    """A file of that kind, as OpenCV writes it."""
    is_encoded, data = cv2.imencode(suffix, values, flags)
    assert is_encoded
    return bytes(data)


def smooth_bgr(height: int, width: int) -> NDArray[np.uint8]:
    """Colours that change little from pixel to pixel, as JPEG keeps them."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack((rows, columns, rows + columns), axis=2).astype(np.uint8)


def smooth_file(suffix: str, *flags: int) -> bytes:
    """`smooth_bgr(40, 60)` as a file of that kind."""
    return image_file(suffix, smooth_bgr(40, 60), *flags)


def claiming_too_much() -> bytes:
    """A file whose header claims more pixels (40000 x 40000) than OpenCV takes in."""
    data = image_file(".bmp", np.zeros((1, 1, 3), np.uint8))
    return data[:18] + struct.pack("<ii", 40_000, 40_000) + data[26:]
