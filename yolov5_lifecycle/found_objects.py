"""Detections one by one, as messages and files tell them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from yolov5_lifecycle.detections import Detections


@dataclass(frozen=True)
class FoundObject:
    """One detection: the name of its class, its score in [0, 1] and its box in pixels of the picture."""

    class_name: str
    score: float
    box_xyxy: tuple[float, float, float, float]

    @property
    def centre_xy(self) -> tuple[float, float]:
        x1, y1, x2, y2 = self.box_xyxy
        return (x1 + x2) / 2, (y1 + y2) / 2

    @property
    def size_xy(self) -> tuple[float, float]:
        """Width and height."""
        x1, y1, x2, y2 = self.box_xyxy
        return x2 - x1, y2 - y1


def found_objects(detections: Detections, class_names: Sequence[str]) -> list[FoundObject]:
    """The rows of `detections`, best first, with class names by id."""
    rows = zip(
        detections.class_ids.tolist(), detections.scores.tolist(), detections.boxes_xyxy.tolist(), strict=True
    )
    return [FoundObject(class_names[class_id], score, tuple(box)) for class_id, score, box in rows]
