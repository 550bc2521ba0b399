"""The folder of kept images while one process writes into it: complete at every moment, within its quota."""

from __future__ import annotations

import itertools
import math
import os
import secrets
import shutil
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from yolov5_lifecycle.atomic_file import UNFINISHED_PREFIX, UNFINISHED_SUFFIX, write_whole
from yolov5_lifecycle.collecting.class_list import read_class_names, with_names, write_class_names
from yolov5_lifecycle.collecting.frame_list import (
    MAX_LIST_BYTES,
    append_line,
    read_frame_list,
    write_frame_list,
)
from yolov5_lifecycle.collecting.kept_looks import KeptLooks
from yolov5_lifecycle.collecting.own_files import CollectingError, own_bytes
from yolov5_lifecycle.collecting.record import CollectedFrame, FrameLine, embedding_of, shades_of_text
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES
from yolov5_lifecycle.unfinished import hold, open_itself, remove_abandoned

_MAX_REMOVED, _MAX_REMOVED_SHARE = 100, 0.05
"""Lines without an image in the list of frames, and their share of the quota, before it is written again."""
_MAX_LINES_BYTES = int(0.8 * MAX_LIST_BYTES)
"""Of lines with an image: the list, with others, stays one that can be read."""
IMAGES, LABELS = "images", "labels"


@dataclass(frozen=True, kw_only=True)
class Quota:
    """What a folder may take of its disk."""

    max_bytes: int
    max_frames: int
    min_free_bytes: int
    """Free on the disk, whoever uses the rest."""


class Drive:
    """All that one process collects, however often it opens the folder: the subfolder of its images.

    `begun_s`: seconds since the epoch, which name it. It stays on the disk on which it begins: if that is
    unmounted, its path is a folder of another one.
    """

    def __init__(self, begun_s: float) -> None:
        self.name = f"{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime(begun_s))}-{secrets.token_hex(3)}"
        self.numbers = itertools.count(1)
        self._mount: Path | None = None

    def begin(self, path: Path) -> None:
        """Images are kept in the folder `path` from now on."""
        self._mount = next(filter(os.path.ismount, (path, *path.parents)), None)

    def check_mounted(self, path: Path) -> None:
        """Raise CollectingError if the disk of the folder `path` has been unmounted."""
        if self._mount is not None and not os.path.ismount(self._mount):
            raise _missing(path)


class CollectedFolder:
    """Owns the folder at `path`, which is created if its parent exists, until `close`.

    Only one process at a time has it, by a lock on the folder. What a killed process left unfinished is
    removed. New images belong to `drive`; None: to a new one.

    Raises CollectingError if another process has the folder, or it is not one of kept images, and OSError.
    """

    def __init__(self, path: Path, quota: Quota, *, drive: Drive | None = None) -> None:
        path = path.resolve()
        self.drive = drive or Drive(time.time())
        self.drive.check_mounted(path)
        if not path.exists():
            path.mkdir()
        self._path = path
        self._quota = quota
        self._removed = self._removed_bytes = 0
        self.class_names: tuple[str, ...] = ()
        self.looks = KeptLooks()
        self._lines: dict[str, FrameLine] = {}
        """By path of the image, in the order in which they were kept."""
        self._descriptor = open_itself(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if not hold(self._descriptor, path):
                raise CollectingError(
                    f"{path}: another process collects into it; give each detector a collect_dir of its own"
                )
            self._read()
            self.drive.begin(path)
        except BaseException:
            os.close(self._descriptor)
            raise

    @property
    def frames(self) -> int:
        return len(self._lines)

    @property
    def lines(self) -> tuple[FrameLine, ...]:
        """Of the kept frames, in the order in which they were kept."""
        return tuple(self._lines.values())

    @property
    def size_bytes(self) -> int:
        """Of images, labels and lines of the list."""
        return sum(line.size for line in self._lines.values()) + self._removed_bytes

    def new_path(self, camera: str) -> str:
        """A new path for an image of `camera`, "" without a name, below the folder."""
        name = f"{next(self.drive.numbers):06d}" + (f"_{camera}" if camera else "")
        return f"{IMAGES}/{self.drive.name}/{name}.jpg"

    def ids_of(self, class_names: Sequence[str]) -> list[int]:
        """The class ids in this folder of a model's `class_names`; adds those that are new to `data.yaml`.

        Raises CollectingError beyond MAX_CLASSES classes or if the disk is another one, and OSError.
        """
        names = with_names(self.class_names, class_names)
        if len(names) > MAX_CLASSES:
            raise CollectingError(
                f"{self._path}: has more than {MAX_CLASSES} classes; use another collect_dir"
            )
        if names != self.class_names:
            self._check_place()
            write_class_names(self._path, names)
            self.class_names = names
        ids = {name: index for index, name in enumerate(names)}
        return [ids[name] for name in class_names]

    def add(self, frame: CollectedFrame, jpeg: bytes, labels: str) -> bool:
        """Keep a frame, and remove less valuable ones if the quota needs it; False if all are more valuable.

        The frame is there once its image is, which is written last: an image without labels would count as
        one without objects, and what has no image is removed when the folder is read again.

        Raises CollectingError if the disk has too little space or is another one, and OSError.
        """
        self._check_disk(len(jpeg))
        line = FrameLine.of(frame.line())
        line = replace(line, size=len(jpeg) + len(labels) + len(line.text))
        if not self._make_room(line.value, line):
            return False
        for kind in (IMAGES, LABELS):
            if own_bytes(self._path, f"{kind}/{line.drive}") is None:
                (self._path / kind / line.drive).mkdir(parents=True)
        try:
            append_line(self._path, line)
            write_whole(self._path / line.labels, labels.encode())
            write_whole(self._path / line.image, jpeg)
        except OSError:
            self._unlink(line)
            raise
        self._remember(line, frame)
        return True

    def remove(self, line: FrameLine) -> None:
        """Remove a kept frame. Raises KeyError if it is not there."""
        del self._lines[line.image]
        self.looks.remove(line.image)
        self._unlink(line)

    def close(self) -> None:
        """Let other processes have the folder. Idempotent."""
        if self._descriptor >= 0:
            with suppress(CollectingError, OSError):
                self._check_place()
                self._rewrite(if_removed=1)
            os.close(self._descriptor)
            self._descriptor = -1

    def _check_place(self) -> None:
        """Raise CollectingError if another folder is at the path, or none."""
        is_same = False
        with suppress(OSError):
            is_same = os.path.samestat(self._path.stat(), os.fstat(self._descriptor))
        if not is_same:
            raise _missing(self._path)

    def _check_disk(self, size: int) -> None:
        self._check_place()
        free, least = shutil.disk_usage(self._path).free, self._quota.min_free_bytes
        if free - size < least:
            raise CollectingError(
                f"{self._path}: {free / 1e6:.0f} MB are free on the disk, collect_min_free_mb keeps "
                f"{least / 1e6:.0f}; remove something, or lower collect_max_mb"
            )

    def _make_room(self, value: float, *new: FrameLine) -> bool:
        """Remove the least valuable frames, the oldest first, until those that are `new` fit.

        Returns False, and removes nothing, if one that is worth more than `value` would have to go.
        """
        self._rewrite_if_wasteful()
        wanted = (*self._lines.values(), *new)
        images = len(wanted) - self._quota.max_frames
        size = sum(line.size for line in wanted) + self._removed_bytes - self._quota.max_bytes
        listed = sum(len(line.text) for line in wanted) - _MAX_LINES_BYTES if new else 0
        leaving: list[FrameLine] = []
        remaining = iter(sorted(self._lines.values(), key=lambda kept: kept.value))
        while max(images, size, listed) > 0:
            line = next(remaining, None)
            if line is None or line.value > value:
                return False
            leaving.append(line)
            images -= 1
            size -= line.size - len(line.text)
            listed -= len(line.text)
        for line in leaving:
            self.remove(line)
        self._rewrite_if_wasteful()
        return True

    def _unlink(self, line: FrameLine) -> None:
        """Remove the image, then its labels; a disk that fails keeps them, and they are removed later.

        Its line stays until the list is written again.
        """
        self._removed += 1
        self._removed_bytes += len(line.text)
        for path in (line.image, line.labels):
            with suppress(OSError):
                (self._path / path).unlink(missing_ok=True)

    def _rewrite_if_wasteful(self) -> None:
        """Leave removed frames out of the list if they are many, or much of it."""
        share = self._removed_bytes / min(self._quota.max_bytes, MAX_LIST_BYTES)
        self._rewrite(if_removed=1 if share > _MAX_REMOVED_SHARE else _MAX_REMOVED)

    def _rewrite(self, *, if_removed: int) -> None:
        """Leave removed frames out of the list if they are at least that many."""
        if self._removed >= if_removed:
            write_frame_list(self._path, self._lines.values())
            self._removed = self._removed_bytes = 0

    def _remember(self, line: FrameLine, frame: CollectedFrame) -> None:
        self._lines[line.image] = line
        self.looks.add(line.image, embedding_of(frame.embedding), shades_of_text(frame.shades))

    def _read(self) -> None:
        """Remember what is there, remove what a killed process did not finish and what exceeds the quota."""
        listed = read_frame_list(self._path)
        self.class_names = read_class_names(self._path, is_used=bool(listed.lines))
        for line in listed.lines:
            self._remember(line, line.frame)
        self._removed = listed.broken
        for line in listed.without_image:
            self._unlink(line)
        self._removed_bytes = 0  # the list is written again below
        self._make_room(math.inf)
        self._rewrite(if_removed=1)
        drives = {line.drive for line in (*listed.lines, *listed.without_image)}
        folders = [self._path, *(self._path / kind / drive for kind in (IMAGES, LABELS) for drive in drives)]
        for folder in folders:
            with suppress(OSError):
                remove_abandoned(folder, prefix=UNFINISHED_PREFIX, suffix=UNFINISHED_SUFFIX)


def _missing(path: Path) -> CollectingError:
    return CollectingError(f"{path}: the folder was removed, or its disk unmounted; mount it again")
