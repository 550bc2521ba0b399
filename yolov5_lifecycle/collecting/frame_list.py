"""`frames.jsonl`: a line for each kept image, in the order in which they were kept."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from yolov5_lifecycle.atomic_file import write_whole
from yolov5_lifecycle.collecting.record import MAX_RECORD_BYTES, CollectedFrame, RecordError
from yolov5_lifecycle.unfinished import open_itself

FRAMES = "frames.jsonl"
MAX_FRAMES = 1_000_000
"""Lines that are read."""


@dataclass(frozen=True)
class FrameList:
    """The records in a folder, and how many lines are none: a killed process leaves at most one."""

    frames: tuple[CollectedFrame, ...]
    """Those whose images are there."""
    without_image: tuple[CollectedFrame, ...]
    broken: int


def read_frame_list(folder: Path) -> FrameList:
    """The list in `folder`, empty if there is none; of several lines for one image the last counts.

    Raises OSError.
    """
    listed: dict[str, CollectedFrame] = {}
    broken = 0
    for line in _lines(folder / FRAMES):
        try:
            frame = CollectedFrame.of_line(line)
        except RecordError:
            broken += 1
            continue
        listed.pop(frame.image, None)
        listed[frame.image] = frame
    present = {image for image in listed if os.path.isfile(folder / image)}  # noqa: PTH113 - Path's raises
    return FrameList(
        tuple(frame for image, frame in listed.items() if image in present),
        tuple(frame for image, frame in listed.items() if image not in present),
        broken,
    )


def write_frame_list(folder: Path, frames: Iterable[CollectedFrame]) -> None:
    """Replace the list in `folder`. Raises OSError."""
    write_whole(folder / FRAMES, *(frame.line() for frame in frames))


def append_frame(folder: Path, frame: CollectedFrame) -> None:
    """Add a line to the list in `folder`: the whole line or, if that fails with OSError, nothing."""
    descriptor = open_itself(folder / FRAMES, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    try:
        size, line = os.fstat(descriptor).st_size, frame.line()
        try:
            if (written := os.write(descriptor, line)) < len(line):
                raise OSError(f"{folder / FRAMES}: {written} of {len(line)} bytes written")
            os.fsync(descriptor)
        except OSError:
            os.truncate(descriptor, size)
            raise
    finally:
        os.close(descriptor)


def _lines(path: Path) -> Iterator[bytes]:
    """The lines of the file, each at most one byte longer than a record may be."""
    try:
        file: BinaryIO = open(path, "rb", opener=open_itself)  # noqa: SIM115 - closed below
    except FileNotFoundError:
        return
    with file:
        for _ in range(MAX_FRAMES):
            line = file.readline(MAX_RECORD_BYTES + 1)
            if not line:
                return
            yield line
            while not line.endswith(b"\n") and (line := file.readline(MAX_RECORD_BYTES)):
                pass  # the rest of a line that is too long, or nothing after the last one
