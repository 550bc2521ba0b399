"""Which objects of two messages about one image belong together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.tracking.assignment import iou_matrix

MATCHING_IOU = 0.5


def matched(truth: Detection2DArray, seen: Detection2DArray) -> list[tuple[int, int]]:
    """Rows of matching true and seen objects: one to one, same class, IoU >= MATCHING_IOU."""
    ious = iou_matrix(boxes_xyxy(truth), boxes_xyxy(seen))
    ious[np.array(class_names(truth))[:, None] != np.array(class_names(seen))[None, :]] = 0
    pairs: list[tuple[int, int]] = []
    while ious.size and ious.max() >= MATCHING_IOU:
        row, column = map(int, np.unravel_index(ious.argmax(), ious.shape))
        pairs.append((row, column))
        ious[row, :] = ious[:, column] = 0
    return pairs


def class_names(message: Detection2DArray) -> list[str]:
    """The most probable class of each object."""
    return [detection.results[0].hypothesis.class_id for detection in message.detections]


def boxes_xyxy(message: Detection2DArray) -> NDArray[np.float64]:
    """Boxes (n, 4) in pixels of the source."""
    boxes = [detection.bbox for detection in message.detections]
    rows = [(box.center.position.x, box.center.position.y, box.size_x, box.size_y) for box in boxes]
    cxcywh = np.array(rows, np.float64).reshape(-1, 4)
    return np.hstack((cxcywh[:, :2] - cxcywh[:, 2:] / 2, cxcywh[:, :2] + cxcywh[:, 2:] / 2))
