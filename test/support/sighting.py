"""The objects of a message as columns, to compare."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.ros.demo.demonstrations import boxes_xyxy, class_names


@dataclass(frozen=True, eq=False)
class Sighting:
    """Classes, scores and boxes (n, 4), in pixels of the source, of the objects in one image."""

    class_names: tuple[str, ...]
    scores: tuple[float, ...]
    boxes_xyxy: NDArray[np.float64]

    @classmethod
    def of(cls, message: Detection2DArray) -> Sighting:
        scores = tuple(detection.results[0].hypothesis.score for detection in message.detections)
        return cls(tuple(class_names(message)), scores, boxes_xyxy(message))
