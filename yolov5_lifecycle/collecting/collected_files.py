"""Files in a folder of collected images, which may be another robot's: regular files in folders, no links.

The images, their labels, `data.yaml`, and `frames.jsonl`: a line for each image.
"""

from __future__ import annotations

import base64
import os
import re
import stat
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field

from yolov5_lifecycle.atomic_file import atomic_write
from yolov5_lifecycle.collecting.descriptors import SHADES, Embedding, Shades, unit
from yolov5_lifecycle.evaluation.ground_truth import MAX_IMAGES, DataError
from yolov5_lifecycle.evaluation.yolo_folder import read_description
from yolov5_lifecycle.evaluation.yolo_labels import MAX_BYTES as MAX_LABEL_BYTES
from yolov5_lifecycle.settings.parameter_file import MAX_FILE_BYTES
from yolov5_lifecycle.unfinished import open_itself

DATA, FRAMES = "data.yaml", "frames.jsonl"
IMAGES, LABELS = "images", "labels"
MAX_LIST_BYTES = 512 << 20
"""Of the list, which is held in memory; 100,000 usual lines."""
MAX_IMAGE_BYTES = 256 << 20
_KINDS = {"l": "a link", "d": "a folder", "-": "a file"}
MAX_RECORD_BYTES = 32 << 20
"""Of a line; one of 30,000 objects with the longest names has 30 MB, one of 1,000 usual ones 150 kB."""
_MAX_VALUES = 300_000
"""Of a line, and lists and objects in it: one of 30,000 objects has 240,000. Each takes up to 300 bytes."""
MAX_EMBEDDING = 8192
_IMAGE = re.compile(r"images/[0-9A-Za-z-]{1,64}/[0-9]{6,9}(_[0-9A-Za-z_]{1,64})?\.jpg")


class CollectingError(ValueError):
    """Nothing can be kept now, or read; the message has the cause and a remedy."""


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class CollectedObject(_Strict):
    """A predicted object, before anybody corrected it."""

    class_name: str = Field(max_length=1000)
    score: float = Field(ge=0, le=1)
    box_xyxy: tuple[float, float, float, float]
    """In pixels."""
    track_id: str = Field(max_length=100)


class CollectedFrame(_Strict):
    """A kept image: where it comes from, why it was kept, and what a model saw in it."""

    image: str = Field(max_length=200, pattern=f"^{_IMAGE.pattern}$")
    """Path below the folder."""
    camera: str = Field(max_length=100)
    frame_id: str = Field(max_length=1000)
    sec: int
    nanosec: int
    size_wh: tuple[int, int]
    weights_sha256: str = Field(max_length=64)
    configuration: str = Field(max_length=64)
    """Digest of the settings, as in diagnostics."""
    reasons: dict[str, str] = Field(max_length=20)
    """Details in words by the value of `Trigger`; other versions have other triggers."""
    value: float
    """Of a full folder the frames with the lowest value go first."""
    objects: tuple[CollectedObject, ...] = Field(max_length=30_000)
    embedding: str = Field(max_length=3 * MAX_EMBEDDING)
    """See `embedding_text`."""
    shades: str = Field(max_length=2 * SHADES)
    """Base64."""

    @classmethod
    def of_line(cls, line: bytes) -> CollectedFrame:
        """The record in `line`. Raises ValueError."""
        if len(line) > MAX_RECORD_BYTES or not line.endswith(b"\n"):
            raise ValueError(f"expected a whole line of at most {MAX_RECORD_BYTES} bytes, found {len(line)}")
        if max(line.count(b","), line.count(b"[") + line.count(b"{")) > _MAX_VALUES:
            raise ValueError(f"expected at most {_MAX_VALUES} values, lists and objects, found more")
        frame = cls.model_validate_json(line)
        frame.descriptor()
        return frame

    def descriptor(self) -> tuple[Embedding, Shades]:
        """The embedding, of length 1 or (0,), and the shades. Raises ValueError."""
        embedding = np.frombuffer(base64.b64decode(self.embedding, validate=True), "<f2").astype(np.float32)
        shades = np.frombuffer(base64.b64decode(self.shades, validate=True), np.int8)
        if not np.isfinite(embedding).all() or len(shades) != SHADES:
            raise ValueError(f"expected an embedding of finite numbers and {SHADES} shades")
        return embedding, shades


@dataclass(frozen=True)
class FrameLine:
    """A line that is a record, and what many lines are chosen by: the record takes ten times the memory."""

    text: bytes
    image: str
    value: float
    size: int = 0
    """Bytes of the image, its labels and the line; 0 if unknown, or without an image."""

    @classmethod
    def of(cls, frame: CollectedFrame) -> FrameLine:
        return cls(frame.model_dump_json().encode() + b"\n", frame.image, frame.value)

    @property
    def frame(self) -> CollectedFrame:
        return CollectedFrame.of_line(self.text)

    @property
    def session(self) -> str:
        """The name of the subfolder: of the recording session of one process."""
        return self.image.split("/")[1]

    @property
    def labels(self) -> str:
        """Path of the labels below the folder."""
        return "labels" + self.image.removeprefix("images").removesuffix(".jpg") + ".txt"


def embedding_text(embedding: Embedding) -> str:
    """An embedding as float16, little-endian, of length 1, in base64; "" if it has no direction."""
    direction = unit(embedding)
    return "" if direction is None else base64.b64encode(direction.astype("<f2").tobytes()).decode()


def shades_text(shades: Shades) -> str:
    return base64.b64encode(shades.tobytes()).decode()


def own_bytes(folder: Path, path: str, max_bytes: int | None = None) -> int | None:
    """How many bytes the regular file at `path`, names with / between them, below `folder` has; None if it is
    not there. Without `max_bytes`: those of the folder at `path`.

    Raises CollectingError if it has more or, like a folder that leads to it, is something else: a link leads
    elsewhere. `folder` itself may be a link. Raises OSError.
    """
    parent = path.rpartition("/")[0]
    if parent and own_bytes(folder, parent) is None:
        return None
    try:
        status = os.lstat(folder / path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    is_right, expected = (stat.S_ISDIR, "a folder") if max_bytes is None else (stat.S_ISREG, "a regular file")
    found = _KINDS.get(stat.filemode(status.st_mode)[0], "a pipe or device")
    if not is_right(status.st_mode):
        remedy = "replace it by a copy of what should be there"
        raise CollectingError(f"{folder / path}: expected {expected}, found {found}; {remedy}")
    if max_bytes is not None and status.st_size > max_bytes:
        remedy = "remove the file, or use another folder"
        raise CollectingError(
            f"{folder / path}: expected at most {max_bytes:,} bytes, found {status.st_size:,}; {remedy}"
        )
    return status.st_size


@dataclass(frozen=True)
class FrameList:
    """The records in `frames.jsonl`, in the order in which the images were kept."""

    lines: tuple[FrameLine, ...]
    """Those whose images are there."""
    without_image: tuple[FrameLine, ...]
    broken: int
    """Lines that are no record: a killed process leaves at most one."""

    @property
    def frames(self) -> tuple[CollectedFrame, ...]:
        """The records in `lines`."""
        return tuple(line.frame for line in self.lines)


def read_frame_list(folder: Path) -> FrameList:
    """The list in `folder`, empty if there is none; of several lines for one image the last counts.

    Raises CollectingError if the list, an image or labels are too large or no regular files, and OSError.
    """
    listed: dict[str, FrameLine] = {}
    broken = 0
    for text in _lines(folder):
        try:
            frame = CollectedFrame.of_line(text)
        except ValueError:
            broken += 1
            continue
        line = FrameLine(text, frame.image, frame.value)
        listed.pop(line.image, None)
        listed[line.image] = replace(line, size=_size(folder, line))
    present = tuple(line for line in listed.values() if line.size)
    return FrameList(present, tuple(line for line in listed.values() if not line.size), broken)


def _size(folder: Path, line: FrameLine) -> int:
    labels_bytes = own_bytes(folder, line.labels, MAX_LABEL_BYTES) or 0
    image_bytes = own_bytes(folder, line.image, MAX_IMAGE_BYTES)
    return 0 if image_bytes is None else image_bytes + labels_bytes + len(line.text)


def _lines(folder: Path) -> Iterator[bytes]:
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


def write_frame_list(folder: Path, lines: Iterable[FrameLine]) -> None:
    """Replace the list in `folder`. Raises OSError."""
    atomic_write(folder / FRAMES, *(line.text for line in lines))


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


def with_names(known: Sequence[str], names: Iterable[str]) -> tuple[str, ...]:
    """`known`, followed by those of `names` that are not among them."""
    return tuple(dict.fromkeys((*known, *names)))


def write_description(
    path: Path,
    class_names: Sequence[str],
    train: str | Sequence[str] = IMAGES,
    validation: str | Sequence[str] = IMAGES,
) -> None:
    """Write a description of the data set that `evaluate` and trainers of YOLOv5 read. Raises OSError."""
    description = {"train": train, "val": validation, "names": dict(enumerate(class_names))}
    text = yaml.safe_dump(description, allow_unicode=True, sort_keys=False)
    atomic_write(path, f"# Labels are predictions until somebody corrects them.\n{text}".encode())
