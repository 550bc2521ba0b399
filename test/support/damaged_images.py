"""Files of images that are none."""

from __future__ import annotations

import struct

import cv2
import numpy as np


def claiming_too_much() -> bytes:
    """An image file whose header claims more pixels (40000 x 40000) than OpenCV takes in."""
    is_encoded, encoded = cv2.imencode(".bmp", np.zeros((1, 1, 3), np.uint8))
    assert is_encoded
    data = bytearray(np.asarray(encoded).tobytes())
    data[18:26] = struct.pack("<ii", 40_000, 40_000)
    return bytes(data)
