"""Ground truth of images, whatever it was read from, and the problems found in it."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yolov5_lifecycle.input_file import RegularFileError, read_text_file
from yolov5_lifecycle.printable import in_one_line

MAX_BOXES_PER_IMAGE = 10_000
MAX_IMAGES = 250_000
"""In a data set; COCO's training set has 118,287. Each takes about 2 kB."""
MAX_OBJECTS = 2_000_000
"""In all images of a data set; COCO's training set has 860,001. Each takes up to 1 kB while it is read."""
MAX_CLASSES = 10_000
MAX_LISTED = 10
"""Number of problems that are reported one by one; further ones are only counted."""
SPLITS = ("val", "test", "train")
"""Entries of `data.yaml`, of which the first that there is is evaluated."""
_MAX_SHOWN = 300
_MAX_PATH = 100
_OF_WINDOWS = re.compile(r"\\|^[A-Za-z]:/")

Kind = Literal["broken labels", "unusable images", "failed images", "unusable entries"]


class DataError(ValueError):
    """Labelled data, or labels of an image, that cannot be used: expected, found, and what to do."""


def check_count(
    where: object, what: str, count: int, limit: int, *, remedy: str = "evaluate a part of the data"
) -> None:
    """Raise DataError if there are more than `limit` of `what`; `where` and `remedy` are for the message."""
    if count > limit:
        raise DataError(f"{where}: expected at most {limit:,} {what}, found {count:,} or more: {remedy}.")


def check_box_count(count: int) -> None:
    """Raise DataError if an image has more than MAX_BOXES_PER_IMAGE objects."""
    remedy = "the image is left out; correct its labels"
    check_count("the image", "objects", count, MAX_BOXES_PER_IMAGE, remedy=remedy)


def read_data_file(path: Path, max_bytes: int) -> bytes:
    """The content of a text file of a data set, see `read_text_file`; raises DataError, which names it."""
    try:
        return read_text_file(path, max_bytes)
    except (OSError, RegularFileError) as error:
        raise DataError(f"{path}: {error.strerror if isinstance(error, OSError) else error}.") from None


class Problems:
    """Counts what cannot be used and calls `tell` with the first problems, one line each."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self.counts: Counter[Kind] = Counter()
        self.first: list[str] = []
        self._tell = tell

    def add(self, kind: Kind, where: object, reason: object) -> None:
        self.counts[kind] += 1
        if len(self.first) < MAX_LISTED:
            text = f"{kind}: {in_one_line(str(where), _MAX_SHOWN)}: {in_one_line(str(reason), _MAX_SHOWN)}"
            self.first.append(text)
            self._tell(text)
            if len(self.first) == MAX_LISTED:
                self._tell("further problems are only counted")

    @property
    def summary(self) -> str:
        """The counts in one line; empty without problems."""
        return ", ".join(f"{count} {kind}" for kind, count in self.counts.items())


@dataclass(frozen=True, eq=False)
class Boxes:
    """Ground truth boxes of an image, one row per object."""

    xyxy: NDArray[np.float64]
    """(n, 4) finite corners, x1 < x2 and y1 < y2, in pixels or in fractions, see `LabelledImage`."""
    class_ids: NDArray[np.int64]
    """(n,) indices into the class names of the data set or, where it has none, of the model."""
    is_crowd: NDArray[np.bool_]
    """(n,) whether the box surrounds many objects, as COCO's `iscrowd`: detections in it are not counted."""

    @classmethod
    def of(cls, rows: ArrayLike, class_ids: Sequence[int], is_crowd: Sequence[bool] | None = None) -> Boxes:
        """Boxes with the corners `rows`; None: none of them is a crowd."""
        xyxy = np.array(rows, np.float64).reshape(-1, 4)
        crowds = np.zeros(len(xyxy), np.bool_) if is_crowd is None else np.array(is_crowd, np.bool_)
        return cls(xyxy, np.array(class_ids, np.int64), crowds)

    def __len__(self) -> int:
        return len(self.class_ids)

    def scaled(self, size_hw: tuple[int, int]) -> Boxes:
        """These, in fractions, in the pixels of an image of `size_hw`."""
        height, width = size_hw
        return Boxes(self.xyxy * (width, height, width, height), self.class_ids, self.is_crowd)


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """An image file and its labels: boxes in pixels, or in fractions of its width and height."""

    path: Path
    boxes: Boxes
    in_fractions: bool = False
    size_hw: tuple[int, int] | None = None
    """Height and width of the image that the labels were made for, if known."""

    def in_pixels(self, size_hw: tuple[int, int]) -> Boxes:
        """The boxes in an image of `size_hw`; raises DataError if they are outside, or for another size."""
        if self.size_hw is not None and self.size_hw != size_hw:
            expected, found = (f"{width} x {height}" for height, width in (self.size_hw, size_hw))
            raise DataError(f"the labels are for an image of {expected} pixels, found {found}")
        if self.in_fractions:
            return self.boxes.scaled(size_hw)
        height, width = size_hw
        xyxy = self.boxes.xyxy
        if ((xyxy[:, :2] >= (width, height)) | (xyxy[:, 2:] <= 0)).any():
            raise DataError(f"a label is outside of its image of {width} x {height} pixels")
        return self.boxes


@dataclass(frozen=True)
class LabelledFolder:
    """Labelled image files and the names of their classes; None if ids are those of the model."""

    class_names: tuple[str, ...] | None
    images: tuple[LabelledImage, ...]


def confined_path(root: Path, text: str, *, base: Path | None = None) -> Path:
    """The path `text`, relative to `base`; raises DataError if it is outside of the folder `root`.

    `root` is absolute; without `base` it is also what `text` is relative to. Links are followed, `..` is not
    looked up.
    """
    if not text or "\0" in text or len(text) > 4096:
        raise DataError("expected the path of a file or folder")
    path = Path(os.path.normpath((base or root) / text))
    shown = in_one_line(text, _MAX_PATH)
    if _OF_WINDOWS.search(text) and not _exists(path):
        backslash = r"\\" if base else r"\\\\"  # JSON has each twice
        slashes = f"; type sed -i 's|{backslash}|/|g' FILE" if "\\" in text else ""
        drive = f"; make it relative to {base or root}" if text[1:2] == ":" else ""
        raise DataError(f"'{shown}' is a path of Windows{slashes}{drive}")
    if not path.is_relative_to(root):
        # What is relative to the root leaves every root.
        is_helped = (base is not None or Path(text).is_absolute()) and _exists(path)
        remedy = "; --root names the folder that may be read" if is_helped else ""
        raise DataError(f"'{shown}' lies outside of {root}{remedy}")
    return path


def absolute(path: Path) -> Path:
    """`path` from the root of the file system on, without `..`; links are kept."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - Path.resolve would follow links


def _exists(path: Path) -> bool:
    return os.path.exists(path)  # noqa: PTH110 - Path.exists raises if a name is too long
