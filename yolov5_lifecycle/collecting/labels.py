"""Labels in YOLO format: a line per object, a box or a polygon in fractions of the image."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections

_DIGITS = 6


def label_text(
    detections: Detections, size_hw: tuple[int, int], class_ids: Sequence[int], *, as_polygons: bool
) -> str:
    """The lines of `detections` in an image of `size_hw`; `class_ids[i]` is written for their class i.

    What is outside of the image is cut off; an object without area is left out. With `as_polygons` each is
    the outline of its mask; the corners of its box where the mask is empty or missing.
    """
    lines = []
    for row, class_id in enumerate(detections.class_ids.tolist()):
        box = _in_image(detections.boxes_xyxy[row], size_hw)
        if (box[2:] > box[:2]).all():
            values = _polygon(detections, row, box, size_hw) if as_polygons else _cxcywh(box)
            shown = " ".join(f"{value:.{_DIGITS}f}" for value in _fractions(values, size_hw))
            lines.append(f"{class_ids[class_id]} {shown}\n")
    return "".join(lines)


def _in_image(box_xyxy: NDArray[np.float32], size_hw: tuple[int, int]) -> NDArray[np.float64]:
    height, width = size_hw
    return np.clip(box_xyxy.astype(np.float64), 0, [width, height, width, height])


def _cxcywh(box_xyxy: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate([(box_xyxy[:2] + box_xyxy[2:]) / 2, box_xyxy[2:] - box_xyxy[:2]])


def _fractions(values: NDArray[np.float64], size_hw: tuple[int, int]) -> Iterator[float]:
    """x, y, x, y ... in pixels as fractions of width and height."""
    height, width = size_hw
    yield from np.clip(values.reshape(-1, 2) / (width, height), 0, 1).reshape(-1).tolist()


def _polygon(
    detections: Detections, row: int, box: NDArray[np.float64], size_hw: tuple[int, int]
) -> NDArray[np.float64]:
    """The outline x, y, x, y ... of the largest part of a mask."""
    x1, y1, x2, y2 = box
    corners = np.array([x1, y1, x2, y1, x2, y2, x1, y2])
    if detections.masks is None:
        return corners
    window, inside = detections.masks.inside_box(row, detections.boxes_xyxy[row])
    found = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]
    outline = max(found, key=cv2.contourArea, default=None)
    if outline is None or len(outline) < 3 or not cv2.contourArea(outline):
        return corners
    points: NDArray[np.float64] = outline.reshape(-1, 2) + np.array([window.columns.start, window.rows.start])
    return points.astype(np.float64).reshape(-1) + 0.5
