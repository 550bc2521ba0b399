"""Small pictures as compressed files, one of each kind."""

from __future__ import annotations

import functools

import cv2
import numpy as np

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
