"""Size of the last image, used to warm up new models."""

from __future__ import annotations

from dataclasses import dataclass

from yolov5_lifecycle.detection.detector import USUAL_SOURCE_HW


@dataclass
class LastPicture:
    """Height and width of the last image, written by the inference thread; initially a usual size."""

    size_hw: tuple[int, int] = USUAL_SOURCE_HW
