"""Folders of several robots in one."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from yolov5_lifecycle.collecting.collected_files import (
    DATA,
    FRAMES,
    MAX_LIST_BYTES,
    read_class_names,
    read_frame_list,
    with_names,
    write_description,
    write_frame_list,
)
from yolov5_lifecycle.collecting.record import CollectingError, FrameLine
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES, MAX_IMAGES, DataError, check_count
from yolov5_lifecycle.evaluation.yolo_labels import label_text, objects_in


def merge(folders: Sequence[Path], output: Path) -> tuple[int, int]:
    """Copy the images of `folders` and their labels, as they are now, to the new folder `output`.

    Of an image that several folders have, the first folder's counts. Returns the number of images, and how
    many were left out for that. Classes are matched by name. Raises CollectingError if labels cannot be
    read, DataError beyond the limits of a data set or of the disk, and OSError.
    """
    sources: dict[str, tuple[Path, FrameLine, Sequence[int]]] = {}
    names: tuple[str, ...] = ()
    listed = 0
    for folder in folders:
        lines = read_frame_list(folder).lines
        own_names = read_class_names(folder, is_used=bool(lines))
        names = with_names(names, own_names)
        ids = {name: index for index, name in enumerate(names)}
        class_ids = [ids[name] for name in own_names]
        listed += len(lines)
        for line in lines:
            sources.setdefault(line.image, (folder, line, class_ids))
    merged = [line for _, line, _ in sources.values()]
    _check_limits(merged, len(names), shutil.disk_usage(output.parent).free)
    output.mkdir()
    for folder, line, ids_in_output in sources.values():
        _copy(folder, output, line, ids_in_output)
    write_description(output / DATA, names)
    write_frame_list(output, merged)
    return len(merged), listed - len(merged)


def _check_limits(lines: Sequence[FrameLine], class_count: int, free_bytes: int) -> None:
    limits = {
        "images": (len(lines), MAX_IMAGES),
        "classes": (class_count, MAX_CLASSES),
        f"bytes in {FRAMES}": (sum(len(line.text) for line in lines), MAX_LIST_BYTES),
        "bytes, which are free on the disk": (sum(line.size for line in lines), free_bytes),
    }
    for what, (count, limit) in limits.items():
        check_count("all folders", what, count, limit, remedy="merge fewer")


def _copy(folder: Path, output: Path, line: FrameLine, class_ids: Sequence[int]) -> None:
    for path in (output / line.image, output / line.labels):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:
        objects = objects_in(label_text(folder / line.labels) or "", len(class_ids))
    except DataError as error:
        raise CollectingError(f"{folder / line.labels}: {error}; correct it") from None
    rows = ((class_ids[class_id], *values) for class_id, values in objects)
    (output / line.labels).write_text("".join(f"{' '.join(map(str, row))}\n" for row in rows))
    shutil.copyfile(folder / line.image, output / line.image, follow_symlinks=False)
