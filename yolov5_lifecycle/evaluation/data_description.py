"""`data.yaml`: which images a data set in YOLO format has, and what its classes are called."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import yaml

from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES, DataError
from yolov5_lifecycle.input_file import RegularFileError, read_regular_file
from yolov5_lifecycle.settings.class_thresholds import MAX_CLASS_NAME
from yolov5_lifecycle.settings.parameter_yaml import (
    MAX_DEPTH,
    MAX_FILE_BYTES,
    BoundedEvents,
    ParameterYamlError,
)

SPLITS = ("val", "test", "train")
"""The first of these that `data.yaml` has is evaluated."""
_NO_PATH = ("", "~", "null", "Null", "NULL")
"""An entry without a value, as YAML writes it."""


@dataclass(frozen=True)
class DataDescription:
    """The entries of a `data.yaml` that are used here."""

    folder: str
    """The entry `path`, which the others are relative to; "" without one."""
    splits: Mapping[str, tuple[str, ...]]
    """Folders and lists of images by `train`, `val` and `test`; without those that are empty."""
    class_names: tuple[str, ...] | None


def read_description(path: Path) -> DataDescription:
    """Read the `data.yaml` at `path`, with the limits of parameter files. Raises DataError."""
    try:
        events = BoundedEvents(read_regular_file(path, MAX_FILE_BYTES))
        content = next((_node(events, event, 0) for event in events if _begins(event)), {})
    except (ParameterYamlError, RegularFileError, OSError) as error:
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


def _begins(event: yaml.Event) -> bool:
    return isinstance(event, (yaml.ScalarEvent, yaml.SequenceStartEvent, yaml.MappingStartEvent))


def _node(events: Iterator[yaml.Event], event: yaml.Event, depth: int) -> object:
    """The text, list or mapping that begins with `event`; a text is not interpreted."""
    if depth > MAX_DEPTH:
        raise ParameterYamlError(f"nested more than {MAX_DEPTH} deep")
    if isinstance(event, yaml.ScalarEvent):
        return event.value
    if isinstance(event, yaml.SequenceStartEvent):
        return [_node(events, item, depth + 1) for item in _until(events, yaml.SequenceEndEvent)]
    keys = _until(events, yaml.MappingEndEvent)
    # The event after a key begins its value.
    pairs = ((_node(events, key, depth + 1), _node(events, next(events), depth + 1)) for key in keys)
    return {key if isinstance(key, str) else "": value for key, value in pairs}


def _until(events: Iterator[yaml.Event], end: type[yaml.Event]) -> Iterator[yaml.Event]:
    for event in events:
        if isinstance(event, end):
            return
        yield event


def _texts(value: object) -> tuple[str, ...]:
    """The paths in a text or a list of texts."""
    texts = value if isinstance(value, list) else [value]
    if any(isinstance(text, (list, dict)) for text in texts):
        raise ValueError("train, val and test must be paths or lists of paths")
    return tuple(text for text in texts if isinstance(text, str) and text not in _NO_PATH)


def _class_names(names: object) -> tuple[str, ...] | None:
    """Class names of a list, or of a mapping from the ids 0, 1, ..."""
    if isinstance(names, dict):
        if names.keys() != {str(number) for number in range(len(names))}:
            raise ValueError(f"names must have the ids 0 to {len(names) - 1}, each once")
        names = [names[str(number)] for number in range(len(names))]
    if not names:
        return None
    if not isinstance(names, list):
        raise ValueError("names must be a list of class names, or a mapping from 0, 1, ... to them")
    if not all(isinstance(name, str) and name for name in names):
        raise ValueError("names must be texts")
    if len(names) > MAX_CLASSES or any(len(name) > MAX_CLASS_NAME for name in names):
        raise ValueError(f"expected at most {MAX_CLASSES} names of at most {MAX_CLASS_NAME} characters")
    return tuple(names)
