"""Frames as planes of colours, which networks read."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import Order

_PLANES = {"rgb": (0, 1, 2), "bgr": (2, 1, 0)}
_TO_GREY = {"rgb": cv2.COLOR_RGB2GRAY, "bgr": cv2.COLOR_BGR2GRAY}


def write_planes(frame: NDArray[np.uint8], order: Order, planes: NDArray[np.uint8]) -> None:
    """Write a frame (h, w, 3), or (h, w) if it is grey, into `planes`: (3, h, w) RGB or (1, h, w) grey."""
    if order == "grey":
        planes[:] = frame
    elif len(planes) == 1:
        cv2.cvtColor(frame, _TO_GREY[order], dst=planes[0])
    else:
        cv2.split(frame, [planes[plane] for plane in _PLANES[order]])
