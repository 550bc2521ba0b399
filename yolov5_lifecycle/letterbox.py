"""How a picture fits into the network's frame, and how boxes come back."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

PADDING_VALUE = 114
"""The grey around the picture that YOLOv5 was trained with."""


@dataclass(frozen=True)
class Letterbox:
    """The picture, resized with its aspect ratio kept, lies at (`left`, `top`) in a grey network frame.

    All sizes are (height, width) in pixels. Both directions use the same whole numbers, so `undo` is the exact
    inverse of `apply`; YOLOv5 maps boxes back with unrounded ones, half a network pixel away at most.
    """

    source_hw: tuple[int, int]
    network_hw: tuple[int, int]
    resized_hw: tuple[int, int]
    top: int
    left: int

    @classmethod
    def fit(
        cls, source_hw: tuple[int, int], *, image_size: int, stride: int, rectangular: bool = True
    ) -> Letterbox:
        """Enlarge or shrink a picture until its longer side is `image_size`, a multiple of `stride`.

        The shorter side is padded to the next multiple of `stride`, or to a square unless `rectangular`. Rounds like
        `letterbox` of YOLOv5 with `auto=rectangular, scaleup=True`, but leaves no side under one pixel.

        Raises ValueError for a side or an image size that is not positive or no multiple.
        """
        if min(source_hw) < 1:
            raise ValueError(f"The sides of a picture must be at least 1 pixel, found {source_hw}.")
        if image_size < stride or image_size % stride:
            raise ValueError(f"The image size must be a positive multiple of {stride}, found {image_size}.")
        ratio = min(image_size / side for side in source_hw)
        resized_hw = tuple(max(round(side * ratio), 1) for side in source_hw)
        padding_hw = tuple(image_size - side for side in resized_hw)
        if rectangular:
            padding_hw = tuple(padding % stride for padding in padding_hw)
        top, left = (round(padding / 2 - 0.1) for padding in padding_hw)
        height, width = (side + padding for side, padding in zip(resized_hw, padding_hw, strict=True))
        return cls(source_hw, (height, width), (resized_hw[0], resized_hw[1]), top, left)

    def apply(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The network frame (h, w, 3) of a picture (H, W, 3), both uint8 in any order of colours."""
        if pixels.shape[:2] != self.source_hw:
            raise ValueError(f"Expected a picture of {self.source_hw} pixels, found {pixels.shape[:2]}.")
        frame = np.full((*self.network_hw, 3), PADDING_VALUE, np.uint8)
        height, width = self.resized_hw
        inner = frame[self.top : self.top + height, self.left : self.left + width]
        if self.resized_hw == self.source_hw:
            inner[:] = pixels
        else:
            inner[:] = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_LINEAR)
        return frame

    def undo(self, boxes_xyxy: NDArray[np.float32]) -> NDArray[np.float32]:
        """Boxes (n, 4) in network pixels -> boxes in source pixels, clipped to the picture."""
        source_wh, resized_wh = self.source_hw[::-1], self.resized_hw[::-1]
        origin = np.array((self.left, self.top) * 2, np.float32)
        scale = np.array([source / resized for source, resized in zip(source_wh, resized_wh, strict=True)] * 2)
        boxes = (boxes_xyxy - origin) * scale.astype(np.float32)
        return np.clip(boxes, 0, np.array(source_wh * 2, np.float32), dtype=np.float32)
