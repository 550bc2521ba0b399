"""Objects of a camera's last images: which come, go, come back or change their class."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from yolov5_lifecycle.collecting.reason import Reason
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.tracking.assignment import iou_matrix

MAX_OBJECTS = 100
"""Objects of an image that are compared, highest scores first; bounds the time per image."""
_GONE_IMAGES = 3
"""An object that is missing in this many images in a row has gone."""
_FORGOTTEN_IMAGES = 30
_SAME_IOU = 0.3
_BORDER = 0.02
"""An object that is closer to the border than this share of the image may have crossed it."""

Change = tuple[Reason, str]
"""A reason, and what happened in words."""


@dataclass(frozen=True)
class _Object:
    box_xyxy: tuple[float, ...]
    class_id: int
    unseen: int = 0
    """Images since the one that it was seen in."""


class ObjectMemory:
    """Compares the detections of each image with those of the images before.

    An object is the same if its track is, or, without a tracker, if its box overlaps.
    """

    def __init__(self) -> None:
        self._objects: dict[str, _Object] = {}
        self._is_first = True
        self._next = 0

    def changes(
        self, detections: Detections, size_hw: tuple[int, int], class_names: Sequence[str]
    ) -> list[Change]:
        """What changed with these `detections`, in an image of `size_hw`; nothing in the first image."""
        leading = detections[:MAX_OBJECTS]
        seen = dict(self._identified(leading))
        found = [] if self._is_first else [*self._compared(seen, size_hw, class_names)]
        missing = {key: replace(one, unseen=one.unseen + 1) for key, one in self._objects.items()}
        self._objects = {
            key: one for key, one in {**missing, **seen}.items() if one.unseen <= _FORGOTTEN_IMAGES
        }
        self._is_first = False
        return found

    def _compared(
        self, seen: dict[str, _Object], size_hw: tuple[int, int], class_names: Sequence[str]
    ) -> Iterator[Change]:
        for key, one in seen.items():
            name, before = class_names[one.class_id], self._objects.get(key)
            if before is None:
                if not _is_at_border(one, size_hw):
                    yield Reason.APPEARED, f"{name} came"
                continue
            if before.class_id != one.class_id:
                yield Reason.UNSTEADY, f"{class_names[before.class_id]} became {name}"
            elif before.unseen:
                yield Reason.UNSTEADY, f"{name} was lost for {before.unseen} images"
        for key, before in self._objects.items():
            has_gone = key not in seen and before.unseen == _GONE_IMAGES - 1
            if has_gone and not _is_at_border(before, size_hw):
                yield Reason.APPEARED, f"{class_names[before.class_id]} went"

    def _identified(self, detections: Detections) -> Iterator[tuple[str, _Object]]:
        """Each detection with the key of its object; without those that the tracker does not know yet."""
        objects = [
            _Object(tuple(box), class_id)
            for box, class_id in zip(
                detections.boxes_xyxy.tolist(), detections.class_ids.tolist(), strict=True
            )
        ]
        keys = detections.track_ids or self._overlapping(detections)
        return ((key, one) for key, one in zip(keys, objects, strict=True) if key)

    def _overlapping(self, detections: Detections) -> list[str]:
        """The key of the object that each detection overlaps most, a new one if there is none."""
        known = list(self._objects)
        boxes = np.array([self._objects[key].box_xyxy for key in known]).reshape(-1, 4)
        iou = iou_matrix(boxes, detections.boxes_xyxy)
        keys: dict[int, str] = {}
        taken: set[int] = set()
        for row, column in zip(*np.unravel_index(np.argsort(-iou, axis=None), iou.shape), strict=True):
            if iou[row, column] < _SAME_IOU:
                break
            if int(row) not in taken and int(column) not in keys:
                taken.add(int(row))
                keys[int(column)] = known[int(row)]
        return [keys.get(column) or self._new_key() for column in range(len(detections))]

    def _new_key(self) -> str:
        self._next += 1
        return f"object {self._next}"


def _is_at_border(one: _Object, size_hw: tuple[int, int]) -> bool:
    height, width = size_hw
    x1, y1, x2, y2 = one.box_xyxy
    margin_x, margin_y = _BORDER * width, _BORDER * height
    return x1 < margin_x or y1 < margin_y or x2 > width - margin_x or y2 > height - margin_y
