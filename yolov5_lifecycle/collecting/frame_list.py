"""`frames.jsonl`: a line for each kept image, in the order in which they were kept."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from yolov5_lifecycle.atomic_file import write_whole
from yolov5_lifecycle.collecting.own_files import CollectingError, own_bytes
from yolov5_lifecycle.collecting.record import CollectedFrame, FrameLine, RecordError
from yolov5_lifecycle.evaluation.ground_truth import MAX_IMAGES
from yolov5_lifecycle.evaluation.yolo_labels import MAX_BYTES as MAX_LABEL_BYTES
from yolov5_lifecycle.unfinished import open_itself

FRAMES = "frames.jsonl"
MAX_LIST_BYTES = 512 << 20
"""Of the list, which is held in memory; 100,000 usual lines."""
MAX_IMAGE_BYTES = 256 << 20


@dataclass(frozen=True)
class FrameList:
    """The records in a folder, and how many lines are none: a killed process leaves at most one."""

    lines: tuple[FrameLine, ...]
    """Those whose images are there."""
    without_image: tuple[FrameLine, ...]
    broken: int

    @property
    def frames(self) -> tuple[CollectedFrame, ...]:
        """The records in `lines`, which take ten times as much memory as these."""
        return tuple(line.frame for line in self.lines)


def read_frame_list(folder: Path) -> FrameList:
    """The list in `folder`, empty if there is none; of several lines for one image the last counts.

    Raises CollectingError if the list, an image or labels are too large or no regular files, and OSError.
    """
    listed: dict[str, FrameLine] = {}
    broken = 0
    for text in _lines(folder):
        try:
            line = FrameLine.of(text)
        except RecordError:
            broken += 1
            continue
        line = replace(line, size=_size(folder, line))
        listed.pop(line.image, None)
        listed[line.image] = line
    present = tuple(line for line in listed.values() if line.size)
    return FrameList(present, tuple(line for line in listed.values() if not line.size), broken)


def _size(folder: Path, line: FrameLine) -> int:
    """Of image, labels and line; 0 without an image."""
    labels_bytes = own_bytes(folder, line.labels, MAX_LABEL_BYTES) or 0
    image_bytes = own_bytes(folder, line.image, MAX_IMAGE_BYTES)
    return 0 if image_bytes is None else image_bytes + labels_bytes + len(line.text)


def write_frame_list(folder: Path, lines: Iterable[FrameLine]) -> None:
    """Replace the list in `folder`. Raises OSError."""
    write_whole(folder / FRAMES, *(line.text for line in lines))


def append_line(folder: Path, line: FrameLine) -> None:
    """Add a line to the list in `folder`: the whole line or, if that fails with OSError, nothing."""
    descriptor = open_itself(folder / FRAMES, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    try:
        size = os.fstat(descriptor).st_size
        try:
            if (written := os.write(descriptor, line.text)) < len(line.text):
                raise OSError(f"{folder / FRAMES}: {written} of {len(line.text)} bytes written")
            os.fsync(descriptor)
        except OSError:
            os.truncate(descriptor, size)
            raise
    finally:
        os.close(descriptor)


def _lines(folder: Path) -> Iterator[bytes]:
    """The lines of the list in `folder`."""
    if own_bytes(folder, FRAMES, MAX_LIST_BYTES) is None:
        return
    with open(folder / FRAMES, "rb", opener=open_itself) as file:
        for number, line in enumerate(file, start=1):
            if number > MAX_IMAGES:
                raise CollectingError(
                    f"{folder / FRAMES}: expected at most {MAX_IMAGES:,} lines, found more; "
                    "use another folder"
                )
            yield line
