"""Labelled images in COCO format: one JSON file with images, annotations and categories."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, Field, ValidationError
from pydantic_core import from_json

from yolov5_lifecycle.evaluation.ground_truth import (
    MAX_CLASSES,
    MAX_IMAGES,
    MAX_OBJECTS,
    Boxes,
    DataError,
    LabelledFolder,
    LabelledImage,
    Problems,
    absolute,
    check_box_count,
    check_count,
    confined_path,
    read_data_file,
)
from yolov5_lifecycle.images.image import MAX_SIDE_PX
from yolov5_lifecycle.models.class_names import ClassNamesError, class_names_of
from yolov5_lifecycle.printable import in_one_line

MAX_BYTES = 256 << 20
MAX_PARSED_BYTES = 2_000_000_000
"""Of memory for what the file holds, by _BYTES_OF; a file of 256 MiB with polygons has about as many."""
_BYTES_OF = {b"{": 232, b"[": 96, b",": 41, b":": 41, b'"': 28}
"""Memory in Python: an object with a pair, a list, a place in one of them and its number, half a text."""
_MAX_PX = 1e6
_MAX_ID = 1 << 60
"""Python takes larger ones for equal in part, so that many of them would take hours."""


_Id = Annotated[int, Field(strict=True, gt=-_MAX_ID, lt=_MAX_ID)]
_Position = Annotated[float, Field(strict=True, ge=-_MAX_PX, le=_MAX_PX, allow_inf_nan=False)]
_Length = Annotated[float, Field(strict=True, gt=0, le=_MAX_PX, allow_inf_nan=False)]


class _Category(BaseModel):
    id: _Id
    name: Any


class _Image(BaseModel):
    id: _Id
    file_name: str
    height: Any = None
    width: Any = None


class _Annotation(BaseModel):
    category_id: _Id
    bbox: tuple[_Position, _Position, _Length, _Length]
    """x, y, width, height in pixels."""
    iscrowd: Any = None


_Record = TypeVar("_Record", _Category, _Image)


def read_coco_file(path: Path, problems: Problems, *, root: Path | None = None) -> LabelledFolder:
    """The images and labels of the COCO file at `path`.

    The names of images are relative to the folder `root` and may not leave it. Without `root`, it is the
    first of these that has one of the images: the folder of `path`, `images` in it, the folder above, and
    there `images` and the folder of the split, such as `val2017` for `instances_val2017.json`. Problems with
    single records are added to `problems`. Raises DataError if nothing is left or a limit is exceeded.
    """
    content = _content(path)
    categories = _by_id(_Category, content["categories"], "categories", problems)
    try:
        class_names = class_names_of([each.name for each in categories.values()], 0, MAX_CLASSES)
    except ClassNamesError as error:
        raise DataError(f"{path}: {error}.") from None
    images = _by_id(_Image, content["images"], "images", problems)
    folder = absolute(root) if root else _folder(path, list(images.values()), problems)
    class_ids = {number: class_id for class_id, number in enumerate(categories)}
    objects = _objects(content["annotations"], images, class_ids, problems)
    found = []
    for image_id, of_image in objects.items():
        image = images[image_id]
        try:
            image_path = confined_path(folder, image.file_name)
        except DataError as error:
            problems.add("unusable entries", f"image {image_id}", error)
            continue
        boxes, ids, crowds = zip(*of_image, strict=True) if of_image else ((), (), ())
        sides = (image.height, image.width)
        size_hw = sides if all(type(side) is int and 0 < side <= MAX_SIDE_PX for side in sides) else None
        found.append(LabelledImage(image_path, Boxes.of(boxes, ids, crowds), size_hw=size_hw))
    if not any(len(image.boxes) for image in found):
        raise DataError(f"{path}: no image has labels that can be used. {problems.summary}".strip())
    return LabelledFolder(class_names, tuple(found))


def _content(path: Path) -> Mapping[str, list[Any]]:
    text = read_data_file(path, MAX_BYTES)
    # Upper bound of the memory that parsing takes beside `text`.
    size = sum(text.count(mark) * size for mark, size in _BYTES_OF.items())
    size += len(text) * (1 if text.isascii() else 4)
    check_count(path, "bytes of memory for its values", size, MAX_PARSED_BYTES)
    try:
        content = from_json(text)
    except ValueError as error:
        raise DataError(f"{path}: expected JSON: {error}.") from None
    limits = {"images": MAX_IMAGES, "annotations": MAX_OBJECTS, "categories": MAX_CLASSES}
    if not isinstance(content, dict) or not all(isinstance(content.get(key), list) for key in limits):
        raise DataError(f"{path}: expected COCO's lists {', '.join(limits)}.")
    for key, limit in limits.items():
        check_count(path, key, len(content[key]), limit)
    return content


def _by_id(
    kind: type[_Record], records: Iterable[object], what: str, problems: Problems
) -> dict[int, _Record]:
    """The `records` by id; of those with one id the first."""
    found: dict[int, _Record] = {}
    for record in records:
        try:
            one = kind.model_validate(record)
        except ValidationError as error:
            problems.add("unusable entries", what, _reason(error))
            continue
        if found.setdefault(one.id, one) is not one:
            problems.add("unusable entries", what, f"expected a unique id, found {one.id} again")
    return found


def _folder(path: Path, images: list[_Image], problems: Problems) -> Path:
    """The folder of the images: the first one that has any of the first 100."""
    if not images:
        raise DataError(f"{path}: found no image that can be used. {problems.summary}".strip())
    parent = absolute(path).parent
    split = path.stem.rpartition("_")[2]
    near = (parent, parent / "images", parent.parent, parent.parent / "images", parent.parent / split)
    for folder in near:
        if any(_is_there(folder, image.file_name) for image in images[:100]):
            return folder
    try:
        confined_path(parent, images[0].file_name)
    except DataError as error:  # in no folder
        raise DataError(f"{path}: {error}.") from None
    shown = in_one_line(images[0].file_name, 200)
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
) -> dict[int, list[_Object]]:
    """The objects of each image id, without images that have a record that cannot be used."""
    # No id of an annotation becomes a key: many that Python takes for equal in part would take hours.
    objects: dict[int, list[_Object]] = {image_id: [] for image_id in image_ids}
    broken = set[int]()
    for number, record in enumerate(_consumed(records)):
        where = f"annotation number {number}"
        image_id = record.get("image_id") if isinstance(record, dict) else None
        if not isinstance(image_id, int) or image_id not in objects:
            problems.add("broken labels", where, "its image is missing or cannot be used")
        elif image_id not in broken:
            try:
                objects[image_id].append(_object(record, class_ids))
                check_box_count(len(objects[image_id]))
            except ValueError as error:
                problems.add("broken labels", where, _reason(error))
                broken.add(image_id)
    return {image_id: of_image for image_id, of_image in objects.items() if image_id not in broken}


def _consumed(records: list[Any]) -> Iterator[Any]:
    """The records in order; each is forgotten, as together they may take most of the memory."""
    records.reverse()
    while records:
        yield records.pop()


def _object(record: object, class_ids: Mapping[int, int]) -> _Object:
    found = _Annotation.model_validate(record)
    if found.category_id not in class_ids:
        raise DataError(f"expected the id of a category, found {found.category_id}")
    x, y, width, height = found.bbox
    return (x, y, x + width, y + height), class_ids[found.category_id], found.iscrowd in (1, True)


def _reason(error: ValueError) -> str:
    """What is wrong with a record, and where in it."""
    if not isinstance(error, ValidationError):
        return str(error)
    first = error.errors(include_url=False, include_context=False)[0]
    where, value = ".".join(map(str, first["loc"])), first["input"]
    # Of anything but a scalar only the type: it may be large or deeply nested.
    is_scalar = isinstance(value, (str, int, float, type(None)))
    found = repr(value)[:40] if is_scalar else "a list" if isinstance(value, list) else "an object"
    return f"{where}: {first['msg']}, found {found}" if where else f"{first['msg']}, found {found}"
