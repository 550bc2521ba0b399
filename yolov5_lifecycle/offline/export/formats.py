"""The formats of exported detections, and which suffix of an output stands for which."""

from __future__ import annotations

import csv
import json
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import yaml

from yolov5_lifecycle.atomic_file import OutputError
from yolov5_lifecycle.offline.export.detected_image import DetectedImage, NamedImage, Sink
from yolov5_lifecycle.printable import in_one_line

JSON_LINES, YOLO = ".jsonl", ".yolo"
"""Suffixes: JSON lines are the format of images and videos whose output has no suffix."""
COLUMNS = (
    *("width", "height", "class_id", "class_name", "score"),
    *("x_min", "y_min", "x_max", "y_max", "id"),
)
"""Names of the columns behind those that identify the image; boxes in image pixels."""


class Format(Sink):
    """A format of exported detections."""

    description: str
    has_masks = False
    has_ids = True

    def __init__(self, path: Path | None, class_names: Sequence[str], *, masks: bool) -> None:
        """Write to the new file `path`, or to stdout.

        `masks`: whether to write the masks of a segmentation model, if the format has some.
        """
        self._class_names = class_names
        self._masks = masks
        self._file = (
            sys.stdout if path is None else path.open("w", encoding="utf-8", errors="backslashreplace")
        )

    def close(self) -> None:
        if self._file is not sys.stdout:
            self._file.close()


class JsonLines(Format):
    """Writes a line for each image.

    A line has the identity of the image, its size and its detections, boxes in image pixels. With `masks`
    each detection that has a mask gets it as COCO's RLE of the whole image.
    """

    description = "JSON lines"
    has_masks = True

    def add(self, found: DetectedImage) -> None:
        height, width = found.image.size_hw
        objects: list[dict[str, object]] = []
        for row, one in enumerate(found.detections.objects(self._class_names)):
            objects.append({"class_name": one.class_name, "score": one.score, "box_xyxy": one.box_xyxy})
            if found.detections.track_ids:
                objects[row]["id"] = one.track_id
            if self._masks and (mask := found.mask(row)) is not None:
                objects[row]["mask"], _ = mask
        content = {**found.named.identity, "width": width, "height": height, "detections": objects}
        self._file.write(json.dumps(content) + "\n")


class CocoJson(Format):
    """Writes annotations as they come and images at the end.

    Ids of images and annotations begin with 1, because pycocotools takes 0 for none.
    """

    description = "COCO"
    has_masks = True

    def __init__(self, path: Path | None, class_names: Sequence[str], *, masks: bool) -> None:
        super().__init__(path, class_names, masks=masks)
        self._images: list[str] = []
        self._objects = 0
        self._file.write('{"annotations": [')

    def add(self, found: DetectedImage) -> None:
        self._images.append(json.dumps(self._image(found)))
        for row in range(len(found.detections)):
            annotation = json.dumps(self._annotation(found, row))
            self._file.write(f"{',' if self._objects else ''}\n{annotation}")
            self._objects += 1

    def finish(self) -> None:
        categories = [{"id": number, "name": name} for number, name in enumerate(self._class_names)]
        images = ",\n".join(self._images)
        self._file.write(f'],\n"images": [\n{images}],\n"categories": {json.dumps(categories)}}}\n')
        self.close()

    def _image(self, found: DetectedImage) -> dict[str, object]:
        height, width = found.image.size_hw
        identity = dict(found.named.identity)
        file = identity.pop("file", None)
        name = found.named.stem if file is None else Path(str(file)).name
        return {"id": len(self._images) + 1, "file_name": name, "width": width, "height": height, **identity}

    def _annotation(self, found: DetectedImage, row: int) -> dict[str, object]:
        x1, y1, x2, y2 = found.detections.boxes_xyxy[row].tolist()
        annotation: dict[str, object] = {
            "id": self._objects + 1,
            "image_id": len(self._images),
            "category_id": int(found.detections.class_ids[row]),
            "bbox": [x1, y1, x2 - x1, y2 - y1],
            "area": (x2 - x1) * (y2 - y1),
            "iscrowd": 0,
            "score": float(found.detections.scores[row]),
        }
        if self._masks and (mask := found.mask(row)) is not None:
            annotation["segmentation"], annotation["area"] = mask
        if found.detections.track_ids:
            annotation["track_id"] = found.detections.track_ids[row]
        return annotation


class CsvTable(Format):
    """Writes a table with the names of the columns in its first line; `id` is empty without a track."""

    description = "CSV"

    def __init__(self, path: Path | None, class_names: Sequence[str], *, masks: bool) -> None:
        super().__init__(path, class_names, masks=masks)
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._has_header = False

    def add(self, found: DetectedImage) -> None:
        identity, detections = found.named.identity, found.detections
        if not self._has_header:
            self._writer.writerow((*identity, *COLUMNS))
            self._has_header = True
        height, width = found.image.size_hw
        objects = detections.objects(self._class_names)
        for one, class_id in zip(objects, detections.class_ids.tolist(), strict=True):
            row = (width, height, class_id, one.class_name, one.score, *one.box_xyxy, one.track_id)
            self._writer.writerow((*identity.values(), *row))


class YoloFolder(Format):
    """Writes `labels/<image>.txt` for each image to the new folder `path`, and `data.yaml` with the classes.

    An image without detections has an empty file. The data set is complete once its images are in `images`.
    """

    description = "a folder of YOLO text"
    has_ids = False

    def __init__(self, path: Path | None, class_names: Sequence[str], *, masks: bool) -> None:
        assert path is not None
        self._labels = path / "labels"
        self._labels.mkdir(parents=True)
        super().__init__(path / "data.yaml", class_names, masks=masks)
        description = {"train": "images", "val": "images", "names": dict(enumerate(class_names))}
        yaml.safe_dump(description, self._file, allow_unicode=True, sort_keys=False)

    def add(self, found: DetectedImage) -> None:
        lines = "".join(
            f"{class_id} {x:.6f} {y:.6f} {width:.6f} {height:.6f}\n"
            for class_id, (x, y, width, height) in zip(
                found.detections.class_ids.tolist(), _relative_boxes(found), strict=True
            )
        )
        with (self._labels / f"{found.named.stem}.txt").open("x", encoding="ascii") as file:
            file.write(lines)


def check_stems(images: Sequence[NamedImage]) -> None:
    """Raise OutputError if two of `images` would share one file of YOLO text."""
    stem, count = Counter(image.stem.casefold() for image in images).most_common(1)[0]
    if count > 1:
        raise OutputError(
            f"{in_one_line(stem)}: {count} images have this name, but YOLO text has one file for each: "
            "rename them, or choose another format."
        )


def _relative_boxes(found: DetectedImage) -> list[tuple[float, float, float, float]]:
    """Centre, width and height of the part of each box inside the image, as shares of the image."""
    height, width = found.image.size_hw
    return [
        ((x1 + x2) / 2 / width, (y1 + y2) / 2 / height, (x2 - x1) / width, (y2 - y1) / height)
        for x1, y1, x2, y2 in found.inside_xyxy.tolist()
    ]


FORMATS: Mapping[str, type[Format]] = MappingProxyType(
    {JSON_LINES: JsonLines, ".json": CocoJson, ".csv": CsvTable, YOLO: YoloFolder}
)
"""By suffix of the output."""


def format_suffix(output: Path) -> str:
    """The key in FORMATS that the name of `output` ends in, whatever its case; "" if it ends in none."""
    suffix = output.suffix.lower()
    return suffix if suffix in FORMATS else ""


def check_export_name(output: Path) -> None:
    """Raise OutputError if the name of `output` promises a format that does not exist."""
    if output.suffix and not format_suffix(output):
        known = ", ".join(f"{suffix} ({one.description})" for suffix, one in FORMATS.items())
        raise OutputError(f"{output}: expected a name that ends in {known}, found {output.suffix}.")
