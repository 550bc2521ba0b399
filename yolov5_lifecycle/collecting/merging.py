"""Folders of several robots in one."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.collecting.class_list import read_class_names, with_names, write_class_names
from yolov5_lifecycle.collecting.collected_folder import CollectingError
from yolov5_lifecycle.collecting.frame_list import read_frame_list, write_frame_list
from yolov5_lifecycle.collecting.record import CollectedFrame
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES, LabelError
from yolov5_lifecycle.evaluation.yolo_labels import label_text, parsed_labels


def merge(folders: Sequence[Path], output: Path) -> tuple[int, int]:
    """Copy the images of `folders` and their labels, as they are now, to the new folder `output`.

    Of an image that several folders have, the first folder's counts. Returns the number of images, and how
    many were left out for that. Classes are matched by name. Raises CollectingError if labels cannot be read,
    DataError and OSError.
    """
    frames: dict[str, CollectedFrame] = {}
    names: tuple[str, ...] = ()
    listed = 0
    output.mkdir()
    for folder in folders:
        own_names = read_class_names(folder)
        names = with_names(names, own_names)
        class_ids = [names.index(name) for name in own_names]
        for frame in read_frame_list(folder).frames:
            listed += 1
            if frames.setdefault(frame.image, frame) is frame:
                _copy(folder, output, frame, class_ids)
    write_class_names(output, names)
    write_frame_list(output, frames.values())
    return len(frames), listed - len(frames)


def _copy(folder: Path, output: Path, frame: CollectedFrame, class_ids: Sequence[int]) -> None:
    for path in (output / frame.image, output / frame.labels):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        text = label_text(folder / frame.labels) or ""
        parsed_labels(text, len(class_ids) or MAX_CLASSES)  # so that each line begins with one of the classes
    except LabelError as error:
        raise CollectingError(f"{folder / frame.labels}: {error}; correct it") from None
    lines = (line.split(maxsplit=1) for line in text.splitlines() if line.strip())
    renumbered = [f"{class_ids[int(float(class_id))]} {rest}\n" for class_id, rest in lines]
    (output / frame.labels).write_text("".join(renumbered))
    shutil.copyfile(folder / frame.image, output / frame.image)
