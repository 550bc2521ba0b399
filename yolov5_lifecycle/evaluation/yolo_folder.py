"""Labelled images in YOLO format: `images/`, `labels/` and `data.yaml`, which says what is where."""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import yaml

from yolov5_lifecycle.evaluation.ground_truth import (
    MAX_CLASSES,
    MAX_IMAGES,
    MAX_OBJECTS,
    PROGRESS_PERIOD,
    SPLITS,
    DataError,
    LabelledFolder,
    LabelledPath,
    Problems,
    check_count,
    confined_path,
)
from yolov5_lifecycle.evaluation.yolo_labels import label_text, parsed_labels
from yolov5_lifecycle.folder_listing import FolderTree, entries
from yolov5_lifecycle.input_file import RegularFileError, read_text_file
from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH, ClassNamesError, class_names_of
from yolov5_lifecycle.outside_yaml import PlainText, texts_of
from yolov5_lifecycle.sources.source import IMAGE_SUFFIXES

YAML_SUFFIXES = (".yaml", ".yml")
_MAX_YAML_BYTES = 1 << 20
_NO_PATH = ("", "~", "null", "Null", "NULL")
"""An entry without a value, as YAML writes it."""
_RESOLVER = yaml.resolver.Resolver()
_READ = tuple(f"tag:yaml.org,2002:{kind}" for kind in ("bool", "int", "float", "null"))
MAX_LIST_BYTES = 64 << 20
MAX_LABEL_CHARACTERS = 1 << 30
"""Of all label files together; those of COCO's training set, with polygons, have 0.5 GB."""


@dataclass(frozen=True)
class DataDescription:
    """The entries of a `data.yaml` that are used here."""

    folder: str
    """The entry `path`, which the others are relative to; "" without one."""
    splits: Mapping[str, tuple[str, ...]]
    """Folders and lists of images by `train`, `val` and `test`; without those that are empty."""
    class_names: tuple[str, ...] | None


def read_description(path: Path) -> DataDescription:
    """Read the `data.yaml` at `path`, at most a megabyte. Raises DataError."""
    try:
        content = texts_of(read_text_file(path, _MAX_YAML_BYTES))
    except (ValueError, OSError) as error:
        problem = error.strerror if isinstance(error, OSError) else str(error)
        raise DataError(f"{path}: {problem}.") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: expected names and values, such as `val: images` and `names: [cat, dog]`.")
    try:
        splits = {name: _texts(content.get(name)) for name in SPLITS}
        names = _class_names(content.get("names"))
    except ValueError as error:
        raise DataError(f"{path}: {error}.") from None
    folder = content.get("path")
    return DataDescription(
        folder if isinstance(folder, str) and folder not in _NO_PATH else "",
        {name: entries for name, entries in splits.items() if entries},
        names,
    )


def _texts(value: object) -> tuple[str, ...]:
    """The paths in a text or a list of texts."""
    texts = value if isinstance(value, list) else [value]
    if any(isinstance(text, (list, dict)) for text in texts):
        raise ValueError("train, val and test must be paths or lists of paths")
    return tuple(text for text in texts if isinstance(text, str) and text not in _NO_PATH)


def _class_names(names: object) -> tuple[str, ...] | None:
    """Class names of a list, or of a mapping from the ids 0, 1, ..., as a checkpoint of them would have."""
    if not names:
        return None
    if isinstance(names, dict):
        return class_names_of({key: _loaded(name) for key, name in names.items()}, 0, MAX_CLASSES)
    if isinstance(names, list):
        return class_names_of(list(map(_loaded, names)), 0, MAX_CLASSES)
    raise ClassNamesError("names must be a list of class names, or a mapping from 0, 1, ... to them")


def _loaded(name: object) -> object:
    """What YOLOv5 gets for a name: YAML 1.1 reads some that are not quoted as numbers and truth values."""
    if not isinstance(name, PlainText) or len(name) > MAX_NAME_LENGTH:
        return name
    tag = _RESOLVER.resolve(yaml.ScalarNode, name, (True, False))  # type: ignore[no-untyped-call]
    try:
        return yaml.safe_load(name) if tag in _READ else name
    except ValueError:  # such as 0b_, a number without digits
        return name


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
    description = read_description(description_path) if description_path else DataDescription("", {}, None)
    folder = absolute(description_path.parent if description_path else data)
    reader = _Reader(folder, absolute(root) if root else folder, problems)
    problems.progress("looking for images")
    wanted = _entries(description, data, split)
    paths = reader.images(wanted, description.folder)
    class_count = len(description.class_names or ()) or MAX_CLASSES
    if not paths:
        raise DataError(
            f"{data}: there are no images ({', '.join(IMAGE_SUFFIXES)}) in {', '.join(wanted)[:1000]}. "
            "Expected a folder with images/ and labels/, or a data.yaml that names them. "
            f"{problems.summary}".strip()
        )
    images = []
    for number, path in enumerate(paths):
        if number % PROGRESS_PERIOD == 0:
            problems.progress(f"labels: {number} of {len(paths)} images")
        if (image := reader.labelled(path, class_count)) is not None:
            images.append(image)
    if not reader.label_files:
        path = next(iter(paths))
        raise DataError(
            f"{data}: none of {len(paths)} images has a label file: expected "
            f"{_label_path(path, reader.root)} for {path}."
        )
    if not images:
        raise DataError(
            f"{data}: none of {len(paths)} images has labels that can be used: {problems.summary}."
        )
    return LabelledFolder(description.class_names, tuple(images))


def absolute(path: Path) -> Path:
    """`path` from the root of the file system on, without `..`; links are kept."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - Path.resolve would follow links


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
        path = self._located(entry, base)
        if path is None:
            return
        if path.is_dir():
            yield from sorted(filter(_is_image, self._tree.files(path)))
        elif path.suffix.lower() == ".txt":
            yield from self._listed(path)
        elif _is_image(path):
            yield path

    def labelled(self, path: Path, class_count: int) -> LabelledPath | None:
        """The image with its labels, none if it has no label file; None if they are broken."""
        label_path = _label_path(path, self.root)
        text: str | None = ""
        try:
            text = label_text(label_path)
            labels = parsed_labels(text or "", class_count)
        except DataError as error:
            self._problems.add("broken labels", label_path, error)
            labels = None
        self.label_files += text is not None
        self._count(label_path.parent, "characters in label files", len(text or ""), MAX_LABEL_CHARACTERS)
        if labels is None:
            return None
        self._count(label_path.parent, "objects in a data set", len(labels.boxes), MAX_OBJECTS)
        return LabelledPath(path, labels)

    def _count(self, where: Path, what: str, more: int, limit: int) -> None:
        self._counts[what] += more
        check_count(where, what, self._counts[what], limit)

    def _located(self, entry: str, base: str) -> Path | None:
        """The path of an entry; like in YOLOv5, without a leading `../` if only that path exists."""
        below = self._below(base)
        problem: DataError | None = None
        for text in dict.fromkeys((entry, entry.removeprefix("../"))):
            for start in dict.fromkeys((below, self._folder)):
                try:
                    path = confined_path(self.root, text, base=start)
                except DataError as error:
                    problem = problem or error
                    continue
                if os.path.exists(path):  # noqa: PTH110 - Path.exists raises if a name is too long
                    return path
                problem = problem or DataError(f"{path} not found")
        self._problems.add("unusable entries", f"'{entry}' in data.yaml", problem)
        return None

    def _below(self, base: str) -> Path:
        """The folder `path` of `data.yaml`; the folder of `data.yaml` if `path` is outside of the root."""
        if not base:
            return self._folder
        try:
            return confined_path(self.root, base, base=self._folder)
        except DataError as error:
            self._problems.add("unusable entries", "'path' in data.yaml", error)
            return self._folder

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
                    raise DataError(f"expected a file that ends in {', '.join(IMAGE_SUFFIXES)}")
            except DataError as error:
                self._problems.add("unusable entries", path, error)
                continue
            yield image


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
