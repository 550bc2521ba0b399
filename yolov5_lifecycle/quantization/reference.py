"""The reference image in a calibration, on which int8 is compared with fp32 whenever the model is loaded."""

from __future__ import annotations

import base64
import binascii
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from yolov5_lifecycle.images.image import ColourImage

LONGER_SIDE_PX = 64
"""Of the stored image: 12 kB of pixels of 4:3."""
_MAX_SIDE_PX = 128
_MAX_TEXT = 4 * (3 * _MAX_SIDE_PX**2 // 3 + 1)
_CARD_SEED = 1
_CARD_SHAPES = 40

Side = Annotated[int, Field(ge=8, le=_MAX_SIDE_PX)]
Noise = Annotated[float, Field(ge=0, le=1e6)]


class Reference(BaseModel):
    """A calibration image, reduced, and what int8 changed in it when the model was calibrated."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    size_hw: tuple[Side, Side]
    rgb: Annotated[str, Field(max_length=_MAX_TEXT)]
    """Pixels (h, w, 3), RGB of dtype uint8, in base64."""
    noise: Annotated[tuple[Noise, ...], Field(min_length=1, max_length=20)]
    """Of each level, see `Comparison`."""

    @model_validator(mode="after")
    def _has_pixels(self) -> Reference:
        height, width = self.size_hw
        try:
            found = len(base64.b64decode(self.rgb, validate=True))
        except (binascii.Error, ValueError):
            raise ValueError("rgb: expected base64") from None
        if found != 3 * height * width:
            raise ValueError(f"rgb: expected {3 * height * width} bytes of pixels, found {found}")
        return self

    def frame(self, frame_hw: tuple[int, int]) -> NDArray[np.uint8]:
        """The image enlarged to the network input `frame_hw`: (h, w, 3), RGB."""
        pixels = np.frombuffer(base64.b64decode(self.rgb), np.uint8).reshape(*self.size_hw, 3)
        return np.asarray(cv2.resize(pixels, frame_hw[::-1], interpolation=cv2.INTER_LINEAR), np.uint8)


def reduced(image: ColourImage) -> tuple[tuple[int, int], str]:
    """Height and width of `image` reduced to LONGER_SIDE_PX, and its pixels as `Reference.rgb`."""
    height, width = image.size_hw
    scale = LONGER_SIDE_PX / max(height, width)
    size_hw = (max(8, round(height * scale)), max(8, round(width * scale)))
    small = cv2.resize(image.pixels, size_hw[::-1], interpolation=cv2.INTER_AREA)
    rgb = small if image.order == "rgb" else small[..., ::-1]
    return size_hw, base64.b64encode(np.ascontiguousarray(rgb).tobytes()).decode()


def contrast_card(frame_hw: tuple[int, int]) -> NDArray[np.uint8]:
    """Colour ramps, a chequered field and filled shapes of all sizes: (h, w, 3), RGB, always the same.

    It has the contrast that an image in a hostile calibration may lack.
    """
    height, width = frame_hw
    y, x = np.mgrid[0:height, 0:width]
    planes = (x * 255 // width, y * 255 // height, (x // 32 + y // 32) % 2 * 255)
    card = np.ascontiguousarray(np.stack(planes, axis=-1), np.uint8)
    rng = np.random.default_rng(_CARD_SEED)
    for number in range(_CARD_SHAPES):
        colour = [int(value) for value in rng.integers(0, 256, 3)]
        at_x, at_y = int(rng.integers(0, width)), int(rng.integers(0, height))
        radius = int(rng.integers(4, height // 5 + 5))
        if number % 2:
            cv2.circle(card, (at_x, at_y), radius, colour, -1)
        else:
            cv2.rectangle(
                card, (at_x - radius, at_y - radius // 2), (at_x + radius, at_y + radius // 2), colour, -1
            )
    return card
