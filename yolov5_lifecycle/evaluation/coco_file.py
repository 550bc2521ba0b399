"""Labelled images in COCO format: one JSON file with images, annotations and categories."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic_core import from_json

from yolov5_lifecycle.evaluation.ground_truth import (
    MAX_BOXES_PER_IMAGE,
    MAX_CLASSES,
    MAX_IMAGES,
    MAX_OBJECTS,
    Boxes,
    DataError,
    LabelledFolder,
    LabelledPath,
    Labels,
    Problems,
    check_count,
    confined_path,
)
from yolov5_lifecycle.evaluation.yolo_folder import absolute
from yolov5_lifecycle.images.image import MAX_SIDE_PX
from yolov5_lifecycle.input_file import RegularFileError, read_text_file
from yolov5_lifecycle.models.class_names import ClassNamesError, class_names_of
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.sources.source import IMAGE_SUFFIXES

MAX_BYTES = 256 << 20
MAX_PARSED_BYTES = 2_000_000_000
"""Of memory for what the file holds, by _BYTES_OF; a file of 256 MiB with polygons has about as many."""
_BYTES_OF = {b"{": 232, b"[": 96, b",": 41, b":": 41, b'"': 28}
"""Memory in Python: an object with a pair, a list, a place in one of them and its number, half a text."""
_MAX_PX = 1e6
_MAX_ID = 1 << 60
"""Python takes larger ones for equal in part, so that many of them would take hours."""


def read_coco_file(path: Path, problems: Problems, *, root: Path | None = None) -> LabelledFolder:
    """The images and labels of the COCO file at `path`.

    The names of images are relative to the folder `root` and may not leave it. Without `root`, it is the
    first of these that has one of the images: the folder of `path`, `images` in it, the folder above, and
    there `images` and the folder of the split, such as `val2017` for `instances_val2017.json`. Problems with
    single records are added to `problems`. Raises DataError if nothing is left or a limit is exceeded.
    """
    problems.progress("reading the COCO file")
    content = _content(path)
    categories = _categories(content["categories"], problems)
    try:
        class_names = class_names_of(list(categories.values()), 0, MAX_CLASSES)
    except ClassNamesError as error:
        raise DataError(f"{path}: {error}.") from None
    class_ids = {number: class_id for class_id, number in enumerate(categories)}
    images = _images(content["images"], problems)
    folder = absolute(root) if root else _folder(path, images, problems)
    objects = _objects(content["annotations"], images, class_ids, problems)
    found = []
    for image_id, (name, size_hw) in images.items():
        if (of_image := objects[image_id]) is None:
            continue
        try:
            image_path = confined_path(folder, name)
        except DataError as error:
            problems.add("unusable entries", f"image {image_id}", error)
            continue
        boxes, ids, crowds = zip(*of_image, strict=True) if of_image else ((), (), ())
        found.append(LabelledPath(image_path, Labels(Boxes.of(boxes, ids, crowds), size_hw=size_hw)))
    if not found or not any(len(image.labels.boxes) for image in found):
        raise DataError(f"{path}: no image has labels that can be used. {problems.summary}".strip())
    return LabelledFolder(class_names, tuple(found))


def _content(path: Path) -> Mapping[str, list[Any]]:
    try:
        text = read_text_file(path, MAX_BYTES)
    except (OSError, RegularFileError) as error:
        problem = error.strerror if isinstance(error, OSError) else str(error)
        raise DataError(f"{path}: {problem}.") from None
    check_count(path, "bytes of memory for its values", _parsed_bytes(text), MAX_PARSED_BYTES)
    try:
        content = from_json(text)
    except ValueError as error:
        raise DataError(f"{path}: expected JSON: {error}.") from None
    keys = ("images", "annotations", "categories")
    if not isinstance(content, dict) or not all(isinstance(content.get(key), list) for key in keys):
        raise DataError(f"{path}: expected COCO's lists {', '.join(keys)}.")
    for key, limit in zip(keys, (MAX_IMAGES, MAX_OBJECTS, MAX_CLASSES), strict=True):
        check_count(path, key, len(content[key]), limit)
    return content


def _parsed_bytes(text: bytes) -> int:
    """Upper bound of the memory that parsing takes beside `text`."""
    values = sum(text.count(mark) * size for mark, size in _BYTES_OF.items())
    return values + len(text) * (1 if text.isascii() else 4)


def _categories(records: Sequence[Any], problems: Problems) -> dict[int, object]:
    """The names by id."""
    names: dict[int, object] = {}
    for record in records:
        match record:
            case {"id": int(number), "name": name} if (
                abs(number) < _MAX_ID and number not in names and _is_name(name)
            ):
                names[number] = name
                continue
        reason = f"expected a unique id and a name, found {_shown(record)}"
        problems.add("unusable entries", "categories", reason)
    return names


def _is_name(name: object) -> bool:
    """Whether it is a name that a class can have; a class without one could not be told from others."""
    if name is None or (isinstance(name, str) and not name.strip()):
        return False
    try:
        class_names_of([name], 1, 1)
    except ClassNamesError:
        return False
    return True


def _images(records: Sequence[Any], problems: Problems) -> dict[int, tuple[str, tuple[int, int] | None]]:
    """File name and height and width, if given, of the images by id."""
    images: dict[int, tuple[str, tuple[int, int] | None]] = {}
    for record in records:
        match record:
            case {"id": int(number), "file_name": str(name)} if number not in images:
                if abs(number) < _MAX_ID and Path(name[:4096]).suffix.lower() in IMAGE_SUFFIXES:
                    images[number] = (name, _size_hw(record))
                    continue
        problems.add(
            "unusable entries",
            "images",
            f"expected a unique id and an image file, found {_shown(record)}",
        )
    return images


def _size_hw(record: Mapping[str, Any]) -> tuple[int, int] | None:
    match record:
        case {"height": int(height), "width": int(width)} if (
            0 < height <= MAX_SIDE_PX and 0 < width <= MAX_SIDE_PX
        ):
            return height, width
    return None


def _folder(path: Path, images: Mapping[int, tuple[str, object]], problems: Problems) -> Path:
    """The folder of the images: the first one that has any of the first 100."""
    parent = absolute(path).parent
    split = path.stem.rpartition("_")[2]
    near = (parent, parent / "images", parent.parent, parent.parent / "images", parent.parent / split)
    names = [name for name, _ in list(images.values())[:100]]
    for folder in near:
        if any(_is_there(folder, name) for name in names):
            return folder
    if not names:
        raise DataError(f"{path}: found no image that can be used. {problems.summary}".strip())
    try:
        confined_path(parent, names[0])
    except DataError as error:  # in no folder
        raise DataError(f"{path}: {error}.") from None
    shown = in_one_line(names[0], 200)
    raise DataError(
        f"{path}: its images, such as '{shown}', are not next to it: give their folder with --root."
    )


def _is_there(folder: Path, name: str) -> bool:
    try:
        return confined_path(folder, name).exists()
    except (DataError, OSError):
        return False


_Object = tuple[tuple[float, float, float, float], int, bool]
"""Corners in pixels, class id, whether it is a crowd."""


def _objects(
    records: list[Any], image_ids: Iterable[int], class_ids: Mapping[int, int], problems: Problems
) -> dict[int, list[_Object] | None]:
    """The objects of each image id; None for an image with a record that cannot be used."""
    # No id of an annotation becomes a key: many that Python takes for equal in part would take hours.
    objects: dict[int, list[_Object] | None] = {image_id: [] for image_id in image_ids}
    for number, record in enumerate(_consumed(records)):
        image_id = record.get("image_id") if isinstance(record, dict) else None
        if not isinstance(image_id, int) or image_id not in objects:
            reason = "its image is missing or cannot be used"
            problems.add("broken labels", f"annotation number {number}", reason)
            continue
        try:
            found = _object(record, class_ids)
            if (of_image := objects[image_id]) is not None:
                of_image.append(found)
                if len(of_image) > MAX_BOXES_PER_IMAGE:
                    raise DataError(f"its image has more than {MAX_BOXES_PER_IMAGE} objects")
        except DataError as error:
            problems.add("broken labels", f"annotation number {number}", error)
            objects[image_id] = None
    return objects


def _consumed(records: list[Any]) -> Iterator[Any]:
    """The records in order; each is forgotten, as together they may take most of the memory."""
    records.reverse()
    while records:
        yield records.pop()


def _object(record: Mapping[str, Any], class_ids: Mapping[int, int]) -> _Object:
    category_id = record.get("category_id")
    if not isinstance(category_id, int) or category_id not in class_ids:
        raise DataError(f"expected the id of a category, found {_shown(category_id)}")
    match record.get("bbox"):
        case [float() | int(), float() | int(), float() | int(), float() | int()] as bbox:
            x, y, width, height = _pixels(bbox)
        case other:
            raise DataError(f"expected a bbox of 4 numbers, found {_shown(other)}")
    if not (width > 0 and height > 0):
        raise DataError(f"expected a width and height above 0, found {width:g} and {height:g}")
    return (x, y, x + width, y + height), class_ids[category_id], record.get("iscrowd") in (1, True)


def _pixels(bbox: Sequence[float]) -> Iterator[float]:
    for value in bbox:
        # An integer of any length is compared before it is converted.
        if not -_MAX_PX <= value <= _MAX_PX or not math.isfinite(value):
            raise DataError(f"expected pixels of an image, found {str(value)[:20]}")
        yield float(value)


def _shown(value: object) -> str:
    """A scalar, shortened; of anything else only its type: it may be large or deeply nested."""
    if isinstance(value, (str, int, float, type(None))):
        return repr(value)[:40]
    return "a list" if isinstance(value, list) else "an object"
