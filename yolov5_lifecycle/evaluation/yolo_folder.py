"""Labelled images in YOLO format: `images/`, `labels/` and `data.yaml`, which says what is where.

A label file has a line for each object: a box or a polygon in fractions of the image.
"""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from yolov5_lifecycle.evaluation.ground_truth import (
    MAX_BOXES_PER_IMAGE,
    MAX_CLASSES,
    MAX_IMAGES,
    MAX_OBJECTS,
    SPLITS,
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
from yolov5_lifecycle.folder_listing import FolderTree, entries
from yolov5_lifecycle.input_file import RegularFileError, read_text_file
from yolov5_lifecycle.models.class_names import class_names_of
from yolov5_lifecycle.outside_yaml import texts_of
from yolov5_lifecycle.sources.source import IMAGE_SUFFIXES, READABLE_SUFFIXES

YAML_SUFFIXES = (".yaml", ".yml")
_MAX_YAML_BYTES = 1 << 20
_NO_PATH = ("", "~", "null", "Null", "NULL")
"""An entry without a value, as YAML writes it."""
MAX_LIST_BYTES = 64 << 20
MAX_LABEL_CHARACTERS = 1 << 30
"""Of all label files together; those of COCO's training set, with polygons, have 0.5 GB."""
MAX_LABEL_BYTES = 4 << 20
"""Of a label file; the largest of COCO, with polygons, has 60 kB."""
MAX_LINES = 2 * MAX_BOXES_PER_IMAGE
_TOLERANCE = 1e-4
"""How far outside of the image a fraction may be, as tools round."""
_MIN_POLYGON_FIELDS = 7


@dataclass(frozen=True)
class DataDescription:
    """The entries of a `data.yaml` that are used here."""

    folder: str = ""
    """The entry `path`, which the others are relative to; "" without one."""
    splits: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Folders and lists of images by `train`, `val` and `test`; without those that are empty."""
    class_names: tuple[str, ...] | None = None


def read_description(path: Path) -> DataDescription:
    """Read the `data.yaml` at `path`, at most a megabyte. Raises DataError."""
    text = read_data_file(path, _MAX_YAML_BYTES)
    try:
        content = texts_of(text)
        if not isinstance(content, dict):
            raise ValueError("expected names and values, such as `val: images` and `names: [cat, dog]`")
        splits = {name: _paths(content.get(name)) for name in SPLITS}
        names = class_names_of(content["names"], 0, MAX_CLASSES) if content.get("names") else None
        (folder, *_) = (*_paths(content.get("path")), "")
    except ValueError as error:
        raise DataError(f"{path}: {error}.") from None
    return DataDescription(folder, {name: paths for name, paths in splits.items() if paths}, names)


def _paths(value: object) -> tuple[str, ...]:
    """The paths in a text or a list of texts."""
    texts = value if isinstance(value, list) else [value]
    if any(isinstance(text, (list, dict)) for text in texts):
        raise ValueError("path, train, val and test must be paths or lists of paths")
    return tuple(text for text in texts if isinstance(text, str) and text not in _NO_PATH)


def read_yolo_folder(
    data: Path,
    problems: Problems,
    *,
    split: str | None = None,
    root: Path | None = None,
) -> LabelledFolder:
    """The images and labels of `data`: a folder, or the `data.yaml` of one.

    `split`: which entry of `data.yaml`; None: the first of SPLITS that it has. Nothing outside of the folder
    `root` is read; None: the folder of `data.yaml`. Problems with single files are added to `problems`.
    Raises DataError if nothing is left or a limit is exceeded, and OSError.
    """
    description_path = _description_path(data)
    description = read_description(description_path) if description_path else DataDescription()
    folder = absolute(description_path.parent if description_path else data)
    reader = _Reader(folder, absolute(root) if root else folder, problems)
    wanted = _entries(description, data, split)
    paths = reader.images(wanted, description.folder)
    if not paths:
        raise DataError(
            f"{data}: there are no images ({', '.join(READABLE_SUFFIXES)}) in {', '.join(wanted)[:1000]}. "
            "Expected a folder with images/ and labels/, or a data.yaml that names them. "
            f"{problems.summary}".strip()
        )
    class_count = len(description.class_names or ()) or MAX_CLASSES
    images = list(reader.labelled(paths, class_count))
    if not reader.label_files:
        raise DataError(
            f"{data}: none of {len(paths)} images has a label file: expected "
            f"{_label_path(paths[0], reader.root)} for {paths[0]}."
        )
    if not images:
        raise DataError(
            f"{data}: none of {len(paths)} images has labels that can be used: {problems.summary}."
        )
    return LabelledFolder(description.class_names, tuple(images))


def _description_path(data: Path) -> Path | None:
    """The `data.yaml` of `data`, or the only other YAML file in it."""
    if not data.is_dir():
        return data
    if (usual := data / "data.yaml").exists():
        return usual
    found = sorted(file for file in entries(data) if file.suffix.lower() in YAML_SUFFIXES)
    if len(found) > 1:
        names = ", ".join(file.name for file in found[:10])
        raise DataError(f"{data}: expected one data.yaml, found {names}: give the path of one of them.")
    return found[0] if found else None


def _entries(description: DataDescription, data: Path, split: str | None) -> tuple[str, ...]:
    """The entries that name the images: paths of folders and of lists."""
    splits = description.splits
    if split is None:
        usual = "images" if (data if data.is_dir() else data.parent).joinpath("images").is_dir() else "."
        return next((splits[name] for name in SPLITS if name in splits), (usual,))
    if split not in splits:
        raise DataError(f"{data}: there is no entry {split!r}, only: {', '.join(splits) or 'none'}.")
    return splits[split]


class _Reader:
    """Finds images and reads their labels; `label_files` counts those that exist.

    What it reads is limited in total, whatever is repeated.
    """

    def __init__(self, folder: Path, root: Path, problems: Problems) -> None:
        self.root = root
        self.label_files = 0
        self._tree = FolderTree()
        self._counts: Counter[str] = Counter()
        self._folder = folder
        self._problems = problems

    def images(self, wanted: tuple[str, ...], base: str) -> list[Path]:
        """The image files of the entries `wanted`, relative to `base`, each once."""
        paths: dict[Path, None] = {}
        for entry in dict.fromkeys(wanted):
            for path in self._images(entry, base):
                paths[path] = None
                check_count(path.parent, "images in a data set", len(paths), MAX_IMAGES)
        return list(paths)

    def _images(self, entry: str, base: str) -> Iterator[Path]:
        """The image files of an entry: a folder, whatever is below it, or a list of files."""
        try:
            path = self._located(entry, base)
        except DataError as error:
            self._problems.add("unusable entries", f"'{entry}' in data.yaml", error)
            return
        if path.is_dir():
            yield from sorted(filter(_is_image, self._tree.files(path)))
        elif path.suffix.lower() == ".txt":
            yield from self._listed(path)
        elif _is_image(path):
            yield path

    def _located(self, entry: str, base: str) -> Path:
        """The path of an entry, which `base` may precede; raises DataError.

        Like in YOLOv5, it is without a leading `../` if only that path exists.
        """
        problems = []
        for text in (entry, entry.removeprefix("../")):
            for relative in (Path(base, text), Path(text)):
                try:
                    path = confined_path(self.root, str(relative), base=self._folder)
                except DataError as error:
                    problems.append(error)
                    continue
                if os.path.exists(path):  # noqa: PTH110 - Path.exists raises if a name is too long
                    return path
                problems.append(DataError(f"{path} not found"))
        raise problems[0]

    def _listed(self, path: Path) -> Iterator[Path]:
        """The images of a list, one path a line, relative to the list."""
        try:
            text = read_text_file(path, MAX_LIST_BYTES).decode()
        except (OSError, RegularFileError, UnicodeDecodeError) as error:
            self._problems.add("unusable entries", path, error)
            return
        lines = list(islice(io.StringIO(text, newline=None), MAX_IMAGES + 1))
        self._count(path, "lines in the lists of images", len(lines), MAX_IMAGES)
        for line in filter(None, dict.fromkeys(map(str.strip, lines))):
            try:
                image = confined_path(self.root, line, base=path.parent)
                if not _is_image(image):
                    raise DataError(f"expected a file that ends in {', '.join(READABLE_SUFFIXES)}")
            except DataError as error:
                self._problems.add("unusable entries", path, error)
                continue
            yield image

    def labelled(self, paths: Sequence[Path], class_count: int) -> Iterator[LabelledImage]:
        """The images with their labels, none if there is no label file; without those with broken ones."""
        for path in paths:
            label_path = _label_path(path, self.root)
            text: str | None = ""
            try:
                text = label_text(label_path)
                boxes = parsed_labels(text or "", class_count)
            except DataError as error:
                self._problems.add("broken labels", label_path, error)
                boxes = None
            self.label_files += text is not None
            where = label_path.parent
            self._count(where, "characters in label files", len(text or ""), MAX_LABEL_CHARACTERS)
            if boxes is not None:
                self._count(where, "objects in a data set", len(boxes), MAX_OBJECTS)
                yield LabelledImage(path, boxes, in_fractions=True)

    def _count(self, where: Path, what: str, more: int, limit: int) -> None:
        self._counts[what] += more
        check_count(where, what, self._counts[what], limit)


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in IMAGE_SUFFIXES


def _label_path(path: Path, root: Path) -> Path:
    """Where the labels of an image are: in `labels/` instead of the last `images/`, else beside it.

    Above `root`, `images/` only counts if the labels are there: `images/val` may be given as the folder.
    """
    beside = path.with_suffix(".txt")
    parts = list(beside.parts)
    if "images" not in parts[:-1]:
        return beside
    last = len(parts) - 2 - parts[-2::-1].index("images")
    parts[last] = "labels"
    is_below = last >= len(root.parts)
    instead = Path(*parts)
    return instead if is_below or os.path.exists(instead) else beside  # noqa: PTH110 - see _located


def label_text(path: Path) -> str | None:
    """The text of the label file at `path`, for `parsed_labels`; None if it does not exist.

    Raises DataError.
    """
    try:
        return read_text_file(path, MAX_LABEL_BYTES).decode()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except UnicodeDecodeError:
        raise DataError("expected a text, found other bytes") from None
    except (OSError, RegularFileError) as error:
        raise DataError(error.strerror if isinstance(error, OSError) else str(error)) from None


def parsed_labels(text: str, class_count: int) -> Boxes:
    """The labels in `text`, in fractions, with class ids below `class_count`; equal boxes count once.

    Raises DataError, with the line, if one is broken: an image with unknown objects cannot be evaluated.
    """
    boxes: dict[tuple[tuple[float, ...], int], None] = {}
    for number, line in enumerate(io.StringIO(text, newline=None), start=1):
        if number > MAX_LINES:
            raise DataError(f"more than {MAX_LINES} lines")
        try:
            if fields := line.split():
                boxes[_object(fields, class_count)] = None
        except DataError as error:
            raise DataError(f"line {number}: {error}") from None
    check_box_count(len(boxes))
    return Boxes.of(*zip(*boxes, strict=True)) if boxes else Boxes.of([], [])


def _object(fields: list[str], class_count: int) -> tuple[tuple[float, ...], int]:
    """Corners x1, y1, x2, y2 within the image in fractions, and the class id."""
    if len(fields) != 5 and (len(fields) < _MIN_POLYGON_FIELDS or len(fields) % 2 == 0):
        raise DataError(
            "expected a class and 4 numbers (centre and size of a box) or at least 3 points of a polygon, "
            f"found {len(fields)} fields"
        )
    try:
        class_id, *values = map(float, fields)
    except ValueError as error:
        raise DataError(f"expected numbers: {str(error)[:60]}") from None
    if not class_id.is_integer() or not 0 <= class_id < class_count:
        raise DataError(f"expected a class from 0 to {class_count - 1}, found {fields[0][:20]}")
    outside = [value for value in values if not -_TOLERANCE <= value <= 1 + _TOLERANCE]
    if outside:
        raise DataError(f"expected fractions of the image from 0 to 1, found {outside[0]:g}")
    if len(values) == 4:
        cx, cy, width, height = values
        corners = (cx - width / 2, cy - height / 2, cx + width / 2, cy + height / 2)
    else:
        corners = (min(values[0::2]), min(values[1::2]), max(values[0::2]), max(values[1::2]))
    x1, y1, x2, y2 = (min(max(corner, 0.0), 1.0) for corner in corners)
    if not (x1 < x2 and y1 < y2):
        raise DataError("the object has no area")
    return (x1, y1, x2, y2), int(class_id)
