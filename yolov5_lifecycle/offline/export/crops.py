"""A JPEG file of each detection."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from yolov5_lifecycle.atomic_file import OutputError
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.annotated_files import write_image
from yolov5_lifecycle.offline.export.detected_image import DetectedImage, Sink
from yolov5_lifecycle.offline.image_files import DistinctNames

MAX_CROPS = 1_000_000
"""Files of one source: more make a folder unusable."""
MIN_FREE_BYTES = 256 << 20
"""Of the disk: what crops leave free."""
_MAX_NAME_LETTERS = 40
_MAX_STEM_BYTES = 200
_SUFFIX = ".jpg"


class Crops(Sink):
    """Writes the new folder `path`: `<class id>_<class name>/<stem>_<row>.jpg` for each detection.

    A stem that an earlier image has is followed by the number of the image. Detections of one image are
    numbered from 0, the highest score first.
    """

    def __init__(self, path: Path, class_names: Sequence[str]) -> None:
        path.mkdir()
        self._path = path
        self._class_names = class_names
        self._names = DistinctNames()
        self._images = self._count = 0

    def add(self, found: DetectedImage) -> None:
        """Write the crops; raises OutputError beyond MAX_CROPS, and OSError when the disk is nearly full."""
        self._check_room(found)
        name = self._names.of(_cut(found.named.stem), self._images)
        self._images += 1
        for row, class_id in enumerate(found.detections.class_ids.tolist()):
            folder = self._path / f"{class_id}_{_safe(self._class_names[class_id])}"
            folder.mkdir(exist_ok=True)
            write_image(folder / f"{name}_{row}{_SUFFIX}", _crop(found, row))

    def _check_room(self, found: DetectedImage) -> None:
        self._count += len(found.detections)
        if self._count > MAX_CROPS:
            raise OutputError(
                f"--crops: more than {MAX_CROPS:,} detections: raise confidence_threshold, select classes, "
                "or divide the source."
            )
        if len(found.detections) and shutil.disk_usage(self._path).free < MIN_FREE_BYTES:
            raise OSError(
                errno.ENOSPC,
                f"less than {MIN_FREE_BYTES >> 20} MiB are free, which --crops leaves",
                str(self._path),
            )


def _safe(class_name: str) -> str:
    """`class_name` as a part of a file name: letters, digits, - and _ stay, all else becomes _."""
    kept = (letter if letter.isalnum() or letter == "-" else "_" for letter in class_name)
    return "".join(kept)[:_MAX_NAME_LETTERS]


def _cut(stem: str) -> str:
    """`stem` with room for a number and a suffix in a file name of 255 bytes."""
    return os.fsdecode(os.fsencode(stem)[:_MAX_STEM_BYTES])


def _crop(found: DetectedImage, row: int) -> ColourImage:
    """The pixels that the box touches, at least one."""
    height, width = found.image.size_hw
    x1, y1, x2, y2 = found.inside_xyxy[row].tolist()
    left, top = min(int(x1), width - 1), min(int(y1), height - 1)
    right, bottom = max(int(np.ceil(x2)), left + 1), max(int(np.ceil(y2)), top + 1)
    return ColourImage(found.image.pixels[top:bottom, left:right], found.image.order)
