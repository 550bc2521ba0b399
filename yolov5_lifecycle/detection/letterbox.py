"""Letterbox geometry: image -> network input, and boxes back to image pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

PADDING_VALUE = 114
"""Grey value of the padding that YOLOv5 was trained with."""


@dataclass(frozen=True)
class Letterbox:
    """Places an image, resized at constant aspect ratio, at (`left`, `top`) in a grey network input.

    Sizes are (height, width) in pixels. Both directions use the same integers, so `undo` is the exact
    inverse of `apply`. YOLOv5 inverts with unrounded values, which shifts box edges by up to 0.75 network
    pixels: 0.5 where the padding is odd, and 0.25 from rounding the size.
    """

    source_hw: tuple[int, int]
    network_hw: tuple[int, int]
    resized_hw: tuple[int, int]
    top: int
    left: int

    @classmethod
    def fit(cls, source_hw: tuple[int, int], *, image_size: int, stride: int) -> Letterbox:
        """Scale an image up or down so that its longer side is `image_size`, a multiple of `stride`.

        The shorter side is padded to the next multiple of `stride`.
        Rounds like YOLOv5 with `auto=True, scaleup=True`, but with a minimum of one pixel per side.
        """
        height, width = resized_hw = _scaled(source_hw, image_size / max(source_hw))
        network_hw = (height + (image_size - height) % stride, width + (image_size - width) % stride)
        return cls._centred(source_hw, network_hw, resized_hw)

    @classmethod
    def into(cls, source_hw: tuple[int, int], network_hw: tuple[int, int]) -> Letterbox:
        """Scale an image up or down so that it just fits into `network_hw`, of which the rest is padded."""
        scale = min(side / source for side, source in zip(network_hw, source_hw, strict=True))
        return cls._centred(source_hw, network_hw, _scaled(source_hw, scale))

    @classmethod
    def _centred(
        cls, source_hw: tuple[int, int], network_hw: tuple[int, int], resized_hw: tuple[int, int]
    ) -> Letterbox:
        paddings = (side - inner for side, inner in zip(network_hw, resized_hw, strict=True))
        top, left = (round(padding / 2 - 0.1) for padding in paddings)
        return cls(source_hw, network_hw, resized_hw, top, left)

    def apply(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Image (H, W, 3) or (H, W) -> network input (h, w, 3) or (h, w), uint8 in any order of channels."""
        frame = np.full((*self.network_hw, *pixels.shape[2:]), PADDING_VALUE, np.uint8)
        height, width = self.resized_hw
        inner = frame[self.top : self.top + height, self.left : self.left + width]
        # OpenCV copies when the size is unchanged.
        cv2.resize(pixels, (width, height), dst=inner, interpolation=cv2.INTER_LINEAR)
        return frame

    def undo(self, boxes_xyxy: NDArray[np.float32]) -> NDArray[np.float32]:
        """Boxes (n, 4) in network pixels -> boxes in source pixels, clipped to the image."""
        source_wh = np.array(self.source_hw[::-1] * 2, np.float32)
        resized_wh = np.array(self.resized_hw[::-1] * 2, np.float32)
        origin = np.array((self.left, self.top) * 2, np.float32)
        boxes = (boxes_xyxy - origin) * (source_wh / resized_wh)
        return np.clip(boxes, 0, source_wh)


def _scaled(size_hw: tuple[int, int], scale: float) -> tuple[int, int]:
    height, width = (max(round(side * scale), 1) for side in size_hw)
    return height, width
