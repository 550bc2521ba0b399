"""Detections as labels in YOLO format: a text file for each image."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import yaml

from yolov5_lifecycle.atomic_file import OutputError
from yolov5_lifecycle.offline.export.detected_image import DetectedImage, NamedImage
from yolov5_lifecycle.printable import in_one_line


class YoloFolder:
    """Writes the new folder `path`: `labels/<stem>.txt` for each image, and `data.yaml` with the classes.

    An image without detections has an empty file. The data set is complete once its images are in `images`.
    See `Sink`.
    """

    def __init__(self, path: Path, class_names: Sequence[str], *, masks: bool) -> None:
        del masks  # only boxes
        self._labels = path / "labels"
        self._labels.mkdir(parents=True)
        description = {"train": "images", "val": "images", "names": dict(enumerate(class_names))}
        text = yaml.safe_dump(description, allow_unicode=True, sort_keys=False)
        (path / "data.yaml").write_text(text, encoding="utf-8")

    def add(self, found: DetectedImage) -> None:
        """Write the labels; raises OSError."""
        lines = "".join(
            f"{class_id} {x:.6f} {y:.6f} {width:.6f} {height:.6f}\n"
            for class_id, (x, y, width, height) in zip(
                found.detections.class_ids.tolist(), _relative_boxes(found), strict=True
            )
        )
        with (self._labels / f"{found.named.stem}.txt").open("x", encoding="ascii") as file:
            file.write(lines)

    def finish(self) -> None:
        """Nothing is left: each file is complete."""

    def close(self) -> None:
        """Nothing is open."""


def check_stems(images: Sequence[NamedImage]) -> None:
    """Raise OutputError if two of `images` would share one file of labels."""
    stem, count = Counter(image.stem for image in images).most_common(1)[0]
    if count > 1:
        raise OutputError(
            f"{in_one_line(stem)}: {count} images have this name, but YOLO text has one file for each: "
            "rename them, or choose another format."
        )


def _relative_boxes(found: DetectedImage) -> list[tuple[float, float, float, float]]:
    """Centre, width and height of each box inside the image, as shares of the image."""
    height, width = found.image.size_hw
    return [
        ((x1 + x2) / 2 / width, (y1 + y2) / 2 / height, (x2 - x1) / width, (y2 - y1) / height)
        for x1, y1, x2, y2 in found.inside_xyxy.tolist()
    ]
