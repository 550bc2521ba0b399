"""Small images as compressed files."""

from __future__ import annotations

import functools

import cv2
import numpy as np
from numpy.typing import NDArray

KINDS = ("colour.png", "grey.png", "deep.png", "baseline.jpg", "progressive.jpg", "grey.jpg")


@functools.cache
def compressed(kind: str) -> bytes:
    """A whole file of a few pixels."""
    noise = np.random.default_rng(0).integers(0, 256, (9, 12, 3), np.uint8)
    pixels = {"grey": noise[..., 0], "deep": noise.astype(np.uint16) * 257}.get(kind.split(".")[0], noise)
    flags = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1] if kind.startswith("progressive") else []
    is_encoded, data = cv2.imencode(kind[-4:], pixels, flags)
    assert is_encoded
    return np.asarray(data).tobytes()


def smooth_bgr(height: int, width: int) -> NDArray[np.uint8]:
    """Colours that change little from pixel to pixel, as JPEG keeps them."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack((rows, columns, rows + columns), axis=2).astype(np.uint8)


def smooth_file(suffix: str, *flags: int) -> bytes:
    """`smooth_bgr(40, 60)` as a file of that kind."""
    is_encoded, data = cv2.imencode(suffix, smooth_bgr(40, 60), flags)
    assert is_encoded
    return bytes(data)
