"""`data.yaml`: the classes of all models that collected into a folder, by their names."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.atomic_file import write_whole
from yolov5_lifecycle.collecting.own_files import CollectingError, own_bytes
from yolov5_lifecycle.evaluation.data_description import read_description
from yolov5_lifecycle.evaluation.ground_truth import DataError
from yolov5_lifecycle.settings.parameter_file import MAX_FILE_BYTES

DATA = "data.yaml"


def read_class_names(folder: Path, *, is_used: bool) -> tuple[str, ...]:
    """The class names in `folder`, none if it has no `data.yaml`.

    Raises CollectingError if they are broken or too large or, if images use them, missing, and OSError.
    """
    names: tuple[str, ...] = ()
    if own_bytes(folder, DATA, MAX_FILE_BYTES) is not None:
        try:
            names = read_description(folder / DATA).class_names or ()
        except DataError as error:
            raise CollectingError(f"{error} Correct it, or use another folder") from None
    if is_used and not names:
        raise CollectingError(
            f"{folder}: {DATA} is missing, so nobody knows the classes of the labels; bring it back, or use "
            "another folder"
        )
    return names


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
