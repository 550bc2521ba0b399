"""Which drives are for training, and which for validation: neighbouring images would show the same scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence, Set
from pathlib import Path

from yolov5_lifecycle.atomic_file import write_whole
from yolov5_lifecycle.collecting.class_list import names_entry
from yolov5_lifecycle.collecting.collected_folder import IMAGES
from yolov5_lifecycle.collecting.own_files import CollectingError
from yolov5_lifecycle.collecting.record import FrameLine

SPLIT = "split.yaml"
_TOLERANCE = 1.25
"""Drives for validation have at most so many times the share that was asked for."""


def validation_drives(frames: Sequence[FrameLine], share: float) -> tuple[str, ...]:
    """Whole drives with about `share` of the images, in the order of their names.

    At least one drive, and not all. Raises CollectingError if there are fewer than two.
    """
    counts = Counter(frame.drive for frame in frames)
    if len(counts) < 2:
        raise CollectingError(
            f"expected images of at least two drives, found {len(counts)}: a part of a drive is no test of "
            "what was learnt from the rest"
        )
    left, chosen = _TOLERANCE * share * len(frames), list[str]()
    for drive, count in sorted(counts.items(), key=lambda item: (-item[1], item[0])):
        if len(chosen) < len(counts) - 1 and count <= left:
            chosen.append(drive)
            left -= count
    smallest = min(counts, key=lambda drive: (counts[drive], drive))
    return tuple(sorted(chosen or [smallest]))


def write_split(
    folder: Path, frames: Sequence[FrameLine], validation: Set[str], class_names: Sequence[str]
) -> Path:
    """Write a description of the data set with lists of drives; returns its path. Raises OSError."""
    drives = sorted({frame.drive for frame in frames})
    lines = []
    for name, of_split in (("train", set(drives) - validation), ("val", validation)):
        lines += [f"{name}:", *(f"  - {IMAGES}/{drive}" for drive in drives if drive in of_split)]
    write_whole(folder / SPLIT, "\n".join([*lines, names_entry(class_names)]).encode())
    return folder / SPLIT
