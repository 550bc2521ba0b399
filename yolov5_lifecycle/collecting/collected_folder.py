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
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.atomic_file import hold, open_itself, remove_abandoned_folders, write_together
from yolov5_lifecycle.collecting.collected_files import (
    DATA,
    FRAMES,
    IMAGES,
    LABELS,
    SUFFIXES,
    CollectedFrame,
    CollectingError,
    KeptImage,
    file_of,
    kept_images,
    read_class_names,
    recorded_images,
    write_description,
)
from yolov5_lifecycle.collecting.descriptors import KeptDescriptors
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES
from yolov5_lifecycle.folder_listing import entries

MAX_FRAMES = 20_000
"""By default; each takes about 2 kB of memory."""


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
            _make(path)
        self._quota = quota
        self.size_bytes = 0
        """Of images, labels and records."""
        self.class_names: tuple[str, ...] = ()
        self.descriptors = KeptDescriptors()
        self._images: dict[str, KeptImage] = {}
        """By path, in the order in which they were kept."""
        self._descriptor = open_itself(path, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if not hold(self._descriptor, path):
                raise CollectingError(
                    f"{path}: another process collects into it; give each detector a collect_dir of its own"
                )
            _check_own(path)
            self._read()
            (path / FRAMES).mkdir(exist_ok=True)  # from here on it is a folder of kept images
            self.session.begin(path)
        except BaseException:
            os.close(self._descriptor)
            raise

    def __len__(self) -> int:
        return len(self._images)

    def kept(self, paths: Iterable[str]) -> list[KeptImage]:
        """The images at these paths that are there."""
        return [self._images[path] for path in paths if path in self._images]

    def ids_of(self, class_names: Sequence[str]) -> list[int]:
        """The class ids in this folder of a model's `class_names`; adds those that are new to `data.yaml`.

        Raises CollectingError beyond MAX_CLASSES classes or if the disk is another one, and OSError.
        """
        names = tuple(dict.fromkeys((*self.class_names, *class_names)))
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

        The frame is there once its image is, which comes last: an image without labels would count as one
        without objects, and what has no image is removed when the folder is read again.

        Raises CollectingError if the disk has too little space or is another one, and OSError.
        """
        self._check_disk(len(jpeg))
        files = {FRAMES: frame.model_dump_json().encode(), LABELS: labels.encode(), IMAGES: jpeg}
        size = sum(map(len, files.values()))
        if not self._make_room(frame.value, count=1, size=size):
            return False
        contents = {self._path / file_of(frame.image, kind): content for kind, content in files.items()}
        for path in contents:
            path.parent.mkdir(parents=True, exist_ok=True)
        try:
            write_together(contents)
        except OSError:
            self._unlink(frame.image)
            raise
        self._remember(KeptImage(frame.image, frame.value, size), frame)
        return True

    def remove(self, image: str) -> None:
        """Remove the image at this path. Raises KeyError if it is not there."""
        self.size_bytes -= self._images.pop(image).size
        self.descriptors.remove(image)
        self._unlink(image)

    def close(self) -> None:
        """Let other processes have the folder. Idempotent."""
        if self._descriptor >= 0:
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
                f"{least / 1e6:.0f}; free some, or lower collect_min_free_mb or collect_max_mb"
            )

    def _make_room(self, value: float, *, count: int = 0, size: int = 0) -> bool:
        """Remove the least valuable images, the oldest first, until `count` more of `size` bytes fit.

        Returns False, and removes nothing, if one that is worth more than `value` would have to go.
        """
        if max(self._excess(count, size)) > 0:
            self._forget_missing()
        excess, excess_bytes = self._excess(count, size)
        leaving: list[KeptImage] = []
        remaining = iter(sorted(self._images.values(), key=lambda kept: kept.value))
        while excess > 0 or excess_bytes > 0:
            kept = next(remaining, None)
            if kept is None or kept.value > value:
                return False
            leaving.append(kept)
            excess -= 1
            excess_bytes -= kept.size
        for kept in leaving:
            self.remove(kept.path)
        return True

    def _excess(self, count: int, size: int) -> tuple[int, int]:
        """How many images, and bytes, exceed the quota with `count` more of `size` bytes."""
        return len(self) + count - self._quota.max_frames, self.size_bytes + size - self._quota.max_bytes

    def _forget_missing(self) -> None:
        """Forget images that somebody has deleted, and remove what belongs to them. Raises OSError."""
        present = set[str]()
        for session in {f"{IMAGES}/{kept.session}" for kept in self._images.values()}:
            with suppress(FileNotFoundError):
                present.update(f"{session}/{name}" for name in os.listdir(self._path / session))  # noqa: PTH208 - no Path for each
        for image in self._images.keys() - present:
            self.remove(image)

    def _unlink(self, image: str) -> None:
        """Remove the image, then what belongs to it; a disk that fails keeps them."""
        for kind in SUFFIXES:
            with suppress(OSError):
                (self._path / file_of(image, kind)).unlink(missing_ok=True)

    def _remember(self, kept: KeptImage, frame: CollectedFrame) -> None:
        self._images[kept.path] = kept
        self.size_bytes += kept.size
        self.descriptors.add(kept.path, *frame.descriptor())

    def _read(self) -> None:
        """Remember what is there, remove what a killed process did not finish and what exceeds the quota."""
        for kept, frame in kept_images(self._path):
            self._remember(kept, frame)
        self.class_names = read_class_names(self._path, is_used=bool(self._images))
        for image in recorded_images(self._path):
            if not (self._path / image).exists():
                self._unlink(image)
        self._make_room(math.inf)
        remove_abandoned_folders(self._path)
        for kind in SUFFIXES:
            with suppress(OSError):  # there may be none
                for session in entries(self._path / kind):
                    remove_abandoned_folders(session)


def _make(path: Path) -> None:
    """Create the folder, but not the one around it: where a disk is missing, another would be filled."""
    try:
        path.mkdir()
    except FileNotFoundError:
        raise CollectingError(
            f"{path}: there is no folder {path.parent}; mount the disk that has it, or create it"
        ) from None


def _check_own(path: Path) -> None:
    """Raise CollectingError if the folder holds a data set that nobody has collected: it would be changed."""
    if os.path.lexists(path / FRAMES):
        return
    if others := [name for name in (DATA, IMAGES, LABELS) if os.path.lexists(path / name)]:
        raise CollectingError(
            f"{path}: has {' and '.join(others)}, but no {FRAMES}, so it is another data set, which stays as "
            "it is; set collect_dir to a new or an empty folder"
        )


def _missing(path: Path) -> CollectingError:
    return CollectingError(f"{path}: the folder was removed, or its disk unmounted; mount it again")
