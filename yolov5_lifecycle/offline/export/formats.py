"""A detected image, the formats in which detections are exported, and which suffix stands for which."""

from __future__ import annotations

import csv
import itertools
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, TextIO

import numpy as np
import yaml
from numpy.typing import NDArray

from yolov5_lifecycle.atomic_file import OutputError
from yolov5_lifecycle.detection.detections import Detections
from yolov5_lifecycle.detection.masks import Window
from yolov5_lifecycle.images.image import ColourImage
from yolov5_lifecycle.offline.detecting import StoredImage
from yolov5_lifecycle.printable import in_one_line

JSON_LINES, YOLO = ".jsonl", ".yolo"
"""Suffixes: JSON lines are the format of images and videos whose output has no suffix."""
COLUMNS = (
    *("width", "height", "class_id", "class_name", "score"),
    *("x_min", "y_min", "x_max", "y_max", "id"),
)
"""Names of the columns behind those that identify the image; boxes in image pixels."""
_RLE_CHARACTERS = 7
"""Per number, of 5 bits each: enough for the difference of any two runs of up to 2**32 pixels."""


@dataclass(frozen=True, eq=False)
class DetectedImage:
    """An image of a source, its pixels and what was detected in it; boxes in pixels of the image."""

    stored: StoredImage
    image: ColourImage
    detections: Detections

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


Write = Callable[[DetectedImage], None]
"""Writes an image; raises OutputError, OSError and ImageError."""
Output = AbstractContextManager[Write]
"""Where detected images go, one after the other; complete when its block ends, damaged when that fails."""


class Format(NamedTuple):
    """A format of exported detections."""

    description: str
    open: Callable[[Path | None, Sequence[str], bool], Output]
    """Opens a new file or folder, stdout for None, for these class names, with masks if there are some."""
    has_masks: bool = False
    has_ids: bool = True


@contextmanager
def _json_lines(path: Path | None, class_names: Sequence[str], with_masks: bool) -> Iterator[Write]:
    """A line for each image: its identity, its size and its detections, boxes in image pixels.

    Each detection that has a mask gets it as COCO's RLE of the whole image.
    """

    def write(found: DetectedImage) -> None:
        height, width = found.image.size_hw
        objects: list[dict[str, object]] = []
        for row, one in enumerate(found.detections.objects(class_names)):
            objects.append({"class_name": one.class_name, "score": one.score, "box_xyxy": one.box_xyxy})
            if found.detections.track_ids:
                objects[row]["id"] = one.track_id
            if with_masks and (mask := found.mask(row)) is not None:
                objects[row]["mask"], _ = mask
        content = {**found.stored.identity, "width": width, "height": height, "detections": objects}
        file.write(json.dumps(content) + "\n")

    with _text_file(path) as file:
        yield write


@contextmanager
def _coco_json(path: Path | None, class_names: Sequence[str], with_masks: bool) -> Iterator[Write]:
    """Annotations as they come and images at the end.

    Ids of images and annotations begin with 1, because pycocotools takes 0 for none.
    """
    images: list[str] = []
    ids = itertools.count(1)

    def write(found: DetectedImage) -> None:
        images.append(json.dumps({"id": len(images) + 1, **_coco_image(found)}))
        for row in range(len(found.detections)):
            number = next(ids)
            annotation = {"id": number, "image_id": len(images), **_coco_object(found, row, with_masks)}
            file.write(f"{',' if number > 1 else ''}\n{json.dumps(annotation)}")

    with _text_file(path) as file:
        file.write('{"annotations": [')
        yield write
        categories = [{"id": number, "name": name} for number, name in enumerate(class_names)]
        listed = ",\n".join(images)
        file.write(f'],\n"images": [\n{listed}],\n"categories": {json.dumps(categories)}}}\n')


def _coco_image(found: DetectedImage) -> dict[str, object]:
    height, width = found.image.size_hw
    identity = dict(found.stored.identity)
    file = identity.pop("file", None)
    name = found.stored.stem if file is None else Path(str(file)).name
    return {"file_name": name, "width": width, "height": height, **identity}


def _coco_object(found: DetectedImage, row: int, with_masks: bool) -> dict[str, object]:
    x1, y1, x2, y2 = found.detections.boxes_xyxy[row].tolist()
    one: dict[str, object] = {
        "category_id": int(found.detections.class_ids[row]),
        "bbox": [x1, y1, x2 - x1, y2 - y1],
        "area": (x2 - x1) * (y2 - y1),
        "iscrowd": 0,
        "score": float(found.detections.scores[row]),
    }
    if with_masks and (mask := found.mask(row)) is not None:
        one["segmentation"], one["area"] = mask
    if found.detections.track_ids:
        one["track_id"] = found.detections.track_ids[row]
    return one


@contextmanager
def _csv_table(path: Path | None, class_names: Sequence[str], _: bool) -> Iterator[Write]:
    """A table with the names of the columns in its first line; `id` is empty without a track."""
    has_header = False

    def write(found: DetectedImage) -> None:
        nonlocal has_header
        identity, (height, width) = found.stored.identity, found.image.size_hw
        if not has_header:
            writer.writerow((*identity, *COLUMNS))
            has_header = True
        objects = found.detections.objects(class_names)
        for one, class_id in zip(objects, found.detections.class_ids.tolist(), strict=True):
            row = (width, height, class_id, one.class_name, one.score, *one.box_xyxy, one.track_id)
            writer.writerow((*identity.values(), *row))

    with _text_file(path) as file:
        writer = csv.writer(file, lineterminator="\n")
        yield write


@contextmanager
def _yolo_folder(path: Path | None, class_names: Sequence[str], _: bool) -> Iterator[Write]:
    """`labels/<image>.txt` for each image in the new folder `path`, and `data.yaml` with the classes.

    An image without detections has an empty file. The data set is complete once its images are in `images`.
    """
    assert path is not None
    labels = path / "labels"
    labels.mkdir(parents=True)
    with _text_file(path / "data.yaml") as file:
        description = {"train": "images", "val": "images", "names": dict(enumerate(class_names))}
        yaml.safe_dump(description, file, allow_unicode=True, sort_keys=False)

    def write(found: DetectedImage) -> None:
        with (labels / f"{found.stored.stem}.txt").open("x", encoding="ascii") as file:
            file.writelines(_yolo_lines(found))

    yield write


def _yolo_lines(found: DetectedImage) -> Iterator[str]:
    """Class, centre, width and height of the part of each box inside the image, as shares of the image."""
    height, width = found.image.size_hw
    boxes_xyxy = found.inside_xyxy.tolist()
    for class_id, (x1, y1, x2, y2) in zip(found.detections.class_ids.tolist(), boxes_xyxy, strict=True):
        centre = f"{(x1 + x2) / 2 / width:.6f} {(y1 + y2) / 2 / height:.6f}"
        yield f"{class_id} {centre} {(x2 - x1) / width:.6f} {(y2 - y1) / height:.6f}\n"


@contextmanager
def _text_file(path: Path | None) -> Iterator[TextIO]:
    """The new file `path`, or stdout."""
    if path is None:
        yield sys.stdout
    else:
        with path.open("w", encoding="utf-8", errors="backslashreplace") as file:
            yield file


def check_stems(images: Sequence[StoredImage]) -> None:
    """Raise OutputError if two of `images` would share one file of YOLO text."""
    stem, count = Counter(image.stem.casefold() for image in images).most_common(1)[0]
    if count > 1:
        raise OutputError(
            f"{in_one_line(stem)}: {count} images have this name, but YOLO text has one file for each: "
            "rename them, or choose another format."
        )


FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        JSON_LINES: Format("JSON lines", _json_lines, has_masks=True),
        ".json": Format("COCO", _coco_json, has_masks=True),
        ".csv": Format("CSV", _csv_table),
        YOLO: Format("a folder of YOLO text", _yolo_folder, has_ids=False),
    }
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


def coco_rle(window: Window, inside: NDArray[np.bool_], size_hw: tuple[int, int]) -> dict[str, object]:
    """A mask of a whole image in COCO's run-length encoding, as `pycocotools.mask.encode` writes it.

    `inside` (h, w) says which pixels of `window` belong to the object; outside of it none does. pycocotools
    would need the whole image for each object, and is optional.
    """
    height, width = size_hw
    between = np.zeros((inside.shape[0] + 2, inside.shape[1]), np.bool_)
    between[1:-1] = inside
    rows, columns = np.nonzero(between[1:] != between[:-1])  # pixels that differ from the one above
    # A run that ends at the bottom of a column continues in one that begins at the top of the next.
    places, times = np.unique(
        (window.columns.start + columns) * height + window.rows.start + rows, return_counts=True
    )
    ends = np.append(places[(times == 1) & (places < height * width)], height * width)
    return {"size": [height, width], "counts": _rle_text(np.diff(ends, prepend=0).astype(np.int64))}


def _rle_text(runs: NDArray[np.int64]) -> str:
    """Lengths of runs as text: from the fourth on, the difference from the last but one.

    A number is written as in signed LEB128, but with 5 bits a character, lowest first: bit 5 says that the
    number continues, and 48 is added to make it ASCII.
    """
    numbers = runs.copy()
    numbers[3:] -= runs[1:-2]
    rest = numbers[:, None] >> (5 * np.arange(_RLE_CHARACTERS))  # (n, 7)
    bits = rest & 0x1F
    goes_on = rest >> 5 != np.where(bits & 0x10, -1, 0)
    is_written = np.column_stack((np.ones(len(runs), np.bool_), goes_on[:, :-1]))
    text: bytes = (bits + 0x20 * goes_on + 48)[is_written].astype(np.uint8).tobytes()
    return text.decode("ascii")
