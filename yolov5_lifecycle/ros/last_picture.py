"""What the camera sends, for models that are made while it does."""

from __future__ import annotations

from dataclasses import dataclass

from yolov5_lifecycle.detector import USUAL_SOURCE_HW


@dataclass
class LastPicture:
    """Height and width of the last picture, written by the inference thread; before, what is usual."""

    size_hw: tuple[int, int] = USUAL_SOURCE_HW
