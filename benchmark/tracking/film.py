"""What a camera that moves sees behind the objects: a wall, and the floor if it drives."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmark.tracking.camera_path import SIZE_HW, Pose
from yolov5_lifecycle.sources.scene import cluttered_background

_WALL_DEPTH_M = 30.0
_MARGIN_XY = (400, 200)
"""Pixels of wall beside the image of a still camera."""
_FLOOR_PX = 1024
_PIXELS_PER_M = 60.0
_NOISE_STD = 3.0
_NOISES = 8


class Film:
    """Textured surroundings, and the noise of a sensor.

    `rng` is not used after the construction.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        height, width = SIZE_HW
        self._wall = cluttered_background(rng, (height + 2 * _MARGIN_XY[1], width + 2 * _MARGIN_XY[0]))
        self._floor = cluttered_background(rng, (_FLOOR_PX, _FLOOR_PX))
        noise = rng.normal(0, _NOISE_STD, (_NOISES, height, width, 3))
        self._noise = np.rint(noise).astype(np.int16)
        self._count = 0

    def background(self, pose: Pose) -> NDArray[np.uint8]:
        """The RGB image (H, W, 3) without any object; each call has other noise."""
        corner = np.array(((1, 0, -_MARGIN_XY[0]), (0, 1, -_MARGIN_XY[1]), (0, 0, 1.0)))
        pixels = cv2.warpPerspective(
            self._wall, pose.plane(_WALL_DEPTH_M) @ corner, SIZE_HW[::-1], borderMode=cv2.BORDER_REFLECT_101
        )
        if pose.forward_m is not None:
            floor = cv2.warpPerspective(
                self._floor, pose.floor(_PIXELS_PER_M), SIZE_HW[::-1], borderMode=cv2.BORDER_WRAP
            )
            horizon = round(SIZE_HW[0] / 2 + pose.shift_xy[1]) + 20  # the floor ends at the wall
            pixels[horizon:] = floor[horizon:]
        self._count += 1
        noisy = pixels + self._noise[self._count % _NOISES]
        return np.asarray(np.clip(noisy, 0, 255), np.uint8)
