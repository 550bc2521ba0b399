"""`data.yaml`: the classes of all models that collected into a folder, by their names."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.atomic_file import write_whole
from yolov5_lifecycle.evaluation.data_description import read_description

DATA = "data.yaml"


def read_class_names(folder: Path) -> tuple[str, ...]:
    """The class names in `folder`, none if it has no `data.yaml`. Raises DataError."""
    path = folder / DATA
    return (read_description(path).class_names or ()) if path.exists() else ()


def write_class_names(folder: Path, class_names: Sequence[str]) -> None:
    """Write a description that `evaluate` and trainers of YOLOv5 read. Raises OSError."""
    heading = "# Labels are predictions until somebody corrects them.\ntrain: images\nval: images\n"
    write_whole(folder / DATA, f"{heading}{names_entry(class_names)}".encode())


def names_entry(class_names: Sequence[str]) -> str:
    """The entry `names` of a description, in YAML."""
    # YAML does not read the pair of escapes that JSON has for an emoji.
    lines = (f"  {index}: {json.dumps(name, ensure_ascii=False)}\n" for index, name in enumerate(class_names))
    return f"names:\n{''.join(lines)}"


def with_names(known: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """`known`, followed by those of `names` that are not among them."""
    return tuple(dict.fromkeys((*known, *names)))
