"""Pictures in the layouts that cameras send."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images import Order, Picture

_CONVERSIONS: dict[tuple[Order, str], int | None] = {
    ("rgb", "rgb8"): None,
    ("rgb", "bgr8"): cv2.COLOR_RGB2BGR,
    ("rgb", "mono8"): cv2.COLOR_RGB2GRAY,
    ("rgb", "rgba8"): cv2.COLOR_RGB2RGBA,
    ("rgb", "bgra8"): cv2.COLOR_RGB2BGRA,
    ("bgr", "rgb8"): cv2.COLOR_BGR2RGB,
    ("bgr", "bgr8"): None,
    ("bgr", "mono8"): cv2.COLOR_BGR2GRAY,
    ("bgr", "rgba8"): cv2.COLOR_BGR2RGBA,
    ("bgr", "bgra8"): cv2.COLOR_BGR2BGRA,
}


def encoded(picture: Picture, encoding: str) -> NDArray[np.uint8]:
    """Pixels (H, W, channels) in `encoding`, rgb8, bgr8, mono8, rgba8 or bgra8; else KeyError."""
    conversion = _CONVERSIONS[picture.order, encoding]
    if conversion is None:
        return picture.pixels
    pixels = np.asarray(cv2.cvtColor(picture.pixels, conversion), np.uint8)
    return pixels.reshape(*picture.size_hw, -1)  # OpenCV drops the axis of a single channel
