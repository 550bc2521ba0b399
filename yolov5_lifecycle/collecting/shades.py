"""Where an image is bright and where it is dark, whatever a model sees in it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.images.image import ColourImage

_SIDE = 16
SHADES = _SIDE * _SIDE
_ENOUGH_PX = 256
"""Rows or columns of an image that are read: an average of more is no better."""
_STEPS = 32
"""In a standard deviation."""
_SAME = 1.0
"""Standard deviations by which no part of two images of the same may differ."""

Shades = NDArray[np.int8]
"""(SHADES,) brightness of 16x16 parts of an image: steps of 1/32 standard deviation, from their mean."""


def shades_of(image: ColourImage) -> Shades:
    """The shades of `image`. A change of the exposure does not change them."""
    step = max(min(image.size_hw) // _ENOUGH_PX, 1)
    parts = cv2.resize(image.pixels[::step, ::step], (_SIDE, _SIDE), interpolation=cv2.INTER_AREA)
    brightness = parts.astype(np.float32).mean(axis=2).ravel()
    deviations = (brightness - brightness.mean()) / max(float(brightness.std()), 1e-3)
    return np.asarray(np.clip(np.rint(deviations * _STEPS), -128, 127), np.int8)


def same_shades(shades: Shades, others: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Whether each of `others` (n, SHADES) may show the same as `shades`: (n,)."""
    differences = np.abs(others.astype(np.int16) - shades.astype(np.int16))
    return np.asarray(differences.max(axis=1, initial=0) < _SAME * _STEPS, np.bool_)
