"""An image of a source and its detections, as every format gets them, and what a format is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import StoredImage
from yolov5_lifecycle.offline.run_lengths import coco_rle


class NamedImage(StoredImage, Protocol):
    """A stored image that can be told from the others of its source."""

    @property
    def identity(self) -> Mapping[str, str | int]:
        """What tells it from the others: `file`, `frame`, or `stamp_ns` and `frame`. Raises ImageError."""

    @property
    def stem(self) -> str:
        """Name of files about this image, without a suffix; raises ImageError.

        Image files may share it, other images do not.
        """


@dataclass(frozen=True, eq=False)
class DetectedImage:
    """A named image, its pixels and what was detected in it; boxes in pixels of the image."""

    named: NamedImage
    image: ColourImage
    detections: Detections

    def objects(self, class_names: Sequence[str]) -> list[dict[str, object]]:
        """The detections for JSON: class name, score, box and, with a tracker, id."""
        found: list[dict[str, object]] = [
            {"class_name": one.class_name, "score": one.score, "box_xyxy": one.box_xyxy}
            for one in self.detections.objects(class_names)
        ]
        for one, track_id in zip(found, self.detections.track_ids, strict=False):  # none without a tracker
            one["id"] = track_id
        return found

    def mask(self, row: int) -> tuple[dict[str, object], int] | None:
        """COCO's RLE of the mask of detection `row` and its number of pixels; None without masks."""
        masks = self.detections.masks
        if masks is None:
            return None
        window, inside = masks.inside_box(row, self.detections.boxes_xyxy[row])
        return coco_rle(window, inside, masks.size_hw), int(inside.sum())

    @property
    def inside_xyxy(self) -> NDArray[np.float32]:
        """The boxes, cut at the edges of the image."""
        height, width = self.image.size_hw
        limits = np.array((width, height, width, height), np.float32)
        cut: NDArray[np.float32] = np.clip(self.detections.boxes_xyxy, 0, limits)
        return cut


class Sink(Protocol):
    """Where detected images go, one after the other. `close` releases its files and may be called twice."""

    def add(self, found: DetectedImage) -> None:
        """Write an image; raises OutputError, OSError and ImageError."""

    def finish(self) -> None:
        """Complete the output after the last image; raises OutputError and OSError."""

    def close(self) -> None:
        """Release what is open; output that is not finished may be damaged."""


def utf8(value: str | int) -> str | int:
    """`value` for formats that are UTF-8 throughout: other bytes of a file name become escapes."""
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value
