"""The folder of kept images while one process writes into it: complete at every moment, within its quota."""

from __future__ import annotations

import itertools
import math
import os
import secrets
import shutil
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from yolov5_lifecycle.atomic_file import UNFINISHED_PREFIX, UNFINISHED_SUFFIX, atomic_write
from yolov5_lifecycle.collecting.collected_files import (
    DATA,
    IMAGES,
    LABELS,
    MAX_LIST_BYTES,
    CollectedFrame,
    CollectingError,
    FrameLine,
    append_line,
    own_bytes,
    read_class_names,
    read_frame_list,
    with_names,
    write_description,
    write_frame_list,
)
from yolov5_lifecycle.collecting.descriptors import KeptDescriptors
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES
from yolov5_lifecycle.unfinished import hold, open_itself, remove_abandoned

MAX_FRAMES = 20_000
"""By default; each takes about 10 kB of memory."""
_MAX_REMOVED_SHARE = 0.05
"""Share of the quota that lines without an image may take before the list is written again."""
_MAX_LINES_BYTES = int(0.8 * MAX_LIST_BYTES)
"""Of lines with an image: the list, with others, stays one that can be read."""


@dataclass(frozen=True, kw_only=True)
class Quota:
    """What a folder may take of its disk."""

    max_bytes: int
    min_free_bytes: int
    """Free on the disk, whoever uses the rest."""
    max_frames: int = MAX_FRAMES


class RecordingSession:
    """All that one process collects, however often it opens the folder: the subfolder of its images.

    It stays on the disk on which it begins: if that is unmounted, its path is a folder of another one.
    """

    def __init__(self) -> None:
        self.name = f"{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}-{secrets.token_hex(3)}"
        self._numbers = itertools.count(1)
        self._mount: Path | None = None

    def new_path(self, camera: str) -> str:
        """A new path for an image of `camera`, "" without a name, below the folder."""
        name = f"{next(self._numbers):06d}" + (f"_{camera}" if camera else "")
        return f"{IMAGES}/{self.name}/{name}.jpg"

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
    removed. New images belong to `session`; None: to a new one.

    Raises CollectingError if another process has the folder, or it is not one of kept images, and OSError.
    """

    def __init__(self, path: Path, quota: Quota, *, session: RecordingSession | None = None) -> None:
        self._path = path = path.resolve()
        self.session = session or RecordingSession()
        self.session.check_mounted(path)
        if not path.exists():
            path.mkdir()
        self._quota = quota
        self._limits = np.array([quota.max_frames, quota.max_bytes, _MAX_LINES_BYTES])
        self._used = np.zeros(3, np.int64)
        """See `_costs`."""
        self._removed_bytes = 0
        """Of lines in the list whose images are not there."""
        self.class_names: tuple[str, ...] = ()
        self.descriptors = KeptDescriptors()
        self._lines: dict[str, FrameLine] = {}
        """By path of the image, in the order in which they were kept."""
        self._descriptor = open_itself(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if not hold(self._descriptor, path):
                raise CollectingError(
                    f"{path}: another process collects into it; give each detector a collect_dir of its own"
                )
            self._read()
            self.session.begin(path)
        except BaseException:
            os.close(self._descriptor)
            raise

    @property
    def lines(self) -> tuple[FrameLine, ...]:
        """Of the kept frames, in the order in which they were kept."""
        return tuple(self._lines.values())

    def lines_of(self, images: Iterable[str]) -> list[FrameLine]:
        """Those of `images` that are there."""
        return [self._lines[image] for image in images if image in self._lines]

    @property
    def size_bytes(self) -> int:
        """Of images, labels and lines of the list."""
        return int(self._used[1]) + self._removed_bytes

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
            write_description(self._path / DATA, names)
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
        line = FrameLine.of(frame)
        line = replace(line, size=len(jpeg) + len(labels) + len(line.text))
        if not self._make_room(line.value, line):
            return False
        for kind in (IMAGES, LABELS):
            if own_bytes(self._path, f"{kind}/{line.session}") is None:
                (self._path / kind / line.session).mkdir(parents=True)
        try:
            append_line(self._path, line)
            atomic_write(self._path / line.labels, labels.encode())
            atomic_write(self._path / line.image, jpeg)
        except OSError:
            self._unlink(line)
            raise
        self._remember(line, frame)
        return True

    def remove(self, line: FrameLine) -> None:
        """Remove a kept frame. Raises KeyError if it is not there."""
        del self._lines[line.image]
        self._used -= _costs(line)
        self.descriptors.remove(line.image)
        self._unlink(line)

    def close(self) -> None:
        """Let other processes have the folder. Idempotent."""
        if self._descriptor >= 0:
            with suppress(CollectingError, OSError):
                self._check_place()
                if self._removed_bytes:
                    self._rewrite()
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
        excess = self._used + sum(map(_costs, new)) - self._limits
        excess[1] += self._removed_bytes
        leaving: list[FrameLine] = []
        remaining = iter(sorted(self._lines.values(), key=lambda kept: kept.value))
        while (excess > 0).any():
            line = next(remaining, None)
            if line is None or line.value > value:
                return False
            leaving.append(line)
            excess -= _costs(line)
            excess[1] += len(line.text)  # stays in the list
        for line in leaving:
            self.remove(line)
        if self._removed_bytes > _MAX_REMOVED_SHARE * min(self._quota.max_bytes, MAX_LIST_BYTES):
            self._rewrite()
        return True

    def _unlink(self, line: FrameLine) -> None:
        """Remove the image, then its labels; a disk that fails keeps them, and they are removed later.

        Its line stays until the list is written again.
        """
        self._removed_bytes += len(line.text)
        for path in (line.image, line.labels):
            with suppress(OSError):
                (self._path / path).unlink(missing_ok=True)

    def _rewrite(self) -> None:
        """Leave removed frames out of the list."""
        write_frame_list(self._path, self._lines.values())
        self._removed_bytes = 0

    def _remember(self, line: FrameLine, frame: CollectedFrame) -> None:
        self._lines[line.image] = line
        self._used += _costs(line)
        self.descriptors.add(line.image, *frame.descriptor())

    def _read(self) -> None:
        """Remember what is there, remove what a killed process did not finish and what exceeds the quota."""
        listed = read_frame_list(self._path)
        self.class_names = read_class_names(self._path, is_used=bool(listed.lines))
        for line in listed.lines:
            self._remember(line, line.frame)
        for line in listed.without_image:
            self._unlink(line)
        if listed.broken or listed.without_image:
            self._rewrite()
        self._make_room(math.inf)
        if self._removed_bytes:
            self._rewrite()
        sessions = {line.session for line in (*listed.lines, *listed.without_image)}
        parts = [f"{kind}/{session}" for kind in (IMAGES, LABELS) for session in sessions]
        for folder in (self._path, *(self._path / part for part in parts)):
            with suppress(OSError):
                remove_abandoned(folder, prefix=UNFINISHED_PREFIX, suffix=UNFINISHED_SUFFIX)


def _costs(line: FrameLine) -> NDArray[np.int64]:
    """What a frame takes of the limits: frames, bytes, bytes of the list."""
    return np.array([1, line.size, len(line.text)])


def _missing(path: Path) -> CollectingError:
    return CollectingError(f"{path}: the folder was removed, or its disk unmounted; mount it again")
