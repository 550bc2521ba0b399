"""`data.yaml`: which images a data set in YOLO format has, and what its classes are called."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import yaml

from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES, DataError
from yolov5_lifecycle.input_file import read_text_file
from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH, ClassNamesError, class_names_of
from yolov5_lifecycle.outside_yaml import PlainText, texts_of

_MAX_BYTES = 1 << 20
SPLITS = ("val", "test", "train")
"""The first of these that `data.yaml` has is evaluated."""
_NO_PATH = ("", "~", "null", "Null", "NULL")
"""An entry without a value, as YAML writes it."""

_RESOLVER = yaml.resolver.Resolver()
_READ = tuple(f"tag:yaml.org,2002:{kind}" for kind in ("bool", "int", "float", "null"))


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
        content = texts_of(read_text_file(path, _MAX_BYTES))
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
