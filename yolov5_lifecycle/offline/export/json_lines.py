"""Detections as lines of JSON."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.offline.export.detected_image import DetectedImage


class JsonLines:
    """Writes a line for each image to the new file `path`, or to stdout. See `Sink`."""

    def __init__(self, path: Path | None, class_names: Sequence[str], *, masks: bool) -> None:
        self._file = None if path is None else path.open("w", encoding="utf-8")
        self._class_names = class_names
        self._masks = masks

    def add(self, found: DetectedImage) -> None:
        line = detection_line(found, self._class_names, masks=self._masks)
        (self._file or sys.stdout).write(line)

    def finish(self) -> None:
        self.close()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


def detection_line(found: DetectedImage, class_names: Sequence[str], *, masks: bool) -> str:
    """A line of JSON with the identity of an image, its size and its detections, boxes in image pixels.

    With `masks` each detection that has a mask gets it as COCO's RLE of the whole image.
    """
    height, width = found.image.size_hw
    objects = found.objects(class_names)
    for row, one in enumerate(objects):
        if masks and (mask := found.mask(row)) is not None:
            one["mask"], _ = mask
    content = {**found.named.identity, "width": width, "height": height, "detections": objects}
    return json.dumps(content) + "\n"
