"""Files in a folder of collected images, which may be another robot's: regular files in folders, no links.

`data.yaml`, and of each image the image itself, its labels and its record: `images/SESSION/NAME.jpg`,
`labels/SESSION/NAME.txt` and `frames/SESSION/NAME.json`.
"""

from __future__ import annotations

import base64
import re
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field

from yolov5_lifecycle.atomic_file import atomic_write
from yolov5_lifecycle.collecting.descriptors import SHADES, Embedding, Shades, unit
from yolov5_lifecycle.evaluation.ground_truth import MAX_IMAGES, DataError
from yolov5_lifecycle.evaluation.yolo_folder import MAX_LABEL_BYTES, read_description
from yolov5_lifecycle.folder_listing import FolderTree
from yolov5_lifecycle.settings.parameter_file import MAX_FILE_BYTES

DATA = "data.yaml"
IMAGES, LABELS, FRAMES = "images", "labels", "frames"
SUFFIXES = {IMAGES: ".jpg", LABELS: ".txt", FRAMES: ".json"}
MAX_RECORD_BYTES = 32 << 20
"""One of 30,000 objects with the longest names has 30 MB, one of 1,000 usual ones 150 kB."""
MAX_RECORDS_BYTES = 4 << 30
"""Of all records in a folder; 20,000 of 1,000 objects have 3 GB."""
_MAX_BYTES = {IMAGES: 256 << 20, LABELS: MAX_LABEL_BYTES, FRAMES: MAX_RECORD_BYTES}
_MAX_VALUES = 300_000
"""Of a record, and lists and objects in it: one of 30,000 objects has 240,000. Each takes up to 300 bytes."""
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
    """The record of a kept image: where it comes from, why it was kept, and what a model saw in it."""

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
    def of_json(cls, text: bytes) -> CollectedFrame:
        """The record in `text`. Raises ValueError."""
        if max(text.count(b","), text.count(b"[") + text.count(b"{")) > _MAX_VALUES:
            raise ValueError(f"expected at most {_MAX_VALUES} values, lists and objects, found more")
        frame = cls.model_validate_json(text)
        frame.descriptor()
        return frame

    def descriptor(self) -> tuple[Embedding, Shades]:
        """The embedding, of length 1 or (0,), and the shades. Raises ValueError."""
        embedding = np.frombuffer(base64.b64decode(self.embedding, validate=True), "<f2").astype(np.float32)
        shades = np.frombuffer(base64.b64decode(self.shades, validate=True), np.int8)
        if not np.isfinite(embedding).all() or len(shades) != SHADES:
            raise ValueError(f"expected an embedding of finite numbers and {SHADES} shades")
        return embedding, shades


class KeptImage(NamedTuple):
    """What many images are chosen by: their records take ten times the memory."""

    path: str
    """Below the folder."""
    value: float
    size: int
    """Bytes of the image, its labels and its record."""

    @property
    def session(self) -> str:
        return session_of(self.path)


def session_of(image: str) -> str:
    """The name of the subfolder of the path `image`: of the recording session of one process."""
    return image.split("/")[1]


def file_of(image: str, kind: str) -> str:
    """Path below the folder of what belongs to the path `image`: `kind` is IMAGES, LABELS or FRAMES."""
    return kind + image.removeprefix(IMAGES).removesuffix(SUFFIXES[IMAGES]) + SUFFIXES[kind]


def embedding_text(embedding: Embedding) -> str:
    """An embedding as float16, little-endian, of length 1, in base64; "" if it has no direction."""
    direction = unit(embedding)
    return "" if direction is None else base64.b64encode(direction.astype("<f2").tobytes()).decode()


def shades_text(shades: Shades) -> str:
    return base64.b64encode(shades.tobytes()).decode()


def recorded_images(folder: Path) -> list[str]:
    """The paths of the images in `folder` that have a record, in the order in which they were kept.

    A killed process may have left a record without an image. Raises CollectingError if there are more than
    MAX_IMAGES, or a folder that leads to them is a link, and OSError.
    """
    for kind in SUFFIXES:
        _check_no_link(folder / kind)
    records = (record.relative_to(folder / FRAMES) for record in FolderTree().files(folder / FRAMES))
    suffix = SUFFIXES[FRAMES]
    found = (f"{IMAGES}/{record.with_suffix('.jpg')}" for record in records if record.suffix == suffix)
    images = sorted(filter(_IMAGE.fullmatch, found))
    if len(images) > MAX_IMAGES:
        raise CollectingError(
            f"{folder / FRAMES}: expected at most {MAX_IMAGES:,} records, found more; use another folder"
        )
    for session in set(map(session_of, images)):
        for kind in SUFFIXES:
            _check_no_link(folder / kind / session)
    return images


def kept_images(folder: Path) -> Iterator[tuple[KeptImage, CollectedFrame]]:
    """Each image in `folder` with its record, in the order in which they were kept.

    What is no record, and one without an image, are left out. Raises CollectingError if the image, its labels
    or its record are too large or no regular files, or all records together are, and OSError.
    """
    read_bytes = 0
    for image in recorded_images(folder):
        sizes = {kind: _own_bytes(folder / file_of(image, kind), most) for kind, most in _MAX_BYTES.items()}
        if sizes[IMAGES] is None or (size := sizes[FRAMES]) is None:
            continue
        read_bytes += size
        if read_bytes > MAX_RECORDS_BYTES:
            raise CollectingError(
                f"{folder / FRAMES}: expected at most {MAX_RECORDS_BYTES:,} bytes, found more; "
                "use another folder"
            )
        try:
            frame = CollectedFrame.of_json((folder / file_of(image, FRAMES)).read_bytes())
        except (ValueError, FileNotFoundError):  # a detector may just have removed it
            continue
        if frame.image != image:
            continue
        yield KeptImage(image, frame.value, sum(filter(None, sizes.values()))), frame


def _check_no_link(path: Path) -> None:
    if path.is_symlink():
        remedy = "replace it by a copy of what should be there"
        raise CollectingError(f"{path}: expected a file or folder, found a link; {remedy}")


def _own_bytes(path: Path, max_bytes: int) -> int | None:
    """How many bytes the regular file at `path` has; None if it is not there.

    Raises CollectingError if it has more than `max_bytes`, or is a link or no regular file, and OSError.
    """
    _check_no_link(path)
    try:
        status = path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    is_regular = stat.S_ISREG(status.st_mode)
    if is_regular and status.st_size <= max_bytes:
        return status.st_size
    expected = f"at most {max_bytes:,} bytes" if is_regular else "a regular file"
    found = f"{status.st_size:,}" if is_regular else "a folder, pipe or device"
    raise CollectingError(f"{path}: expected {expected}, found {found}; remove it, or use another folder")


def read_class_names(folder: Path, *, is_used: bool) -> tuple[str, ...]:
    """The class names in `folder`, none if it has no `data.yaml`.

    Raises CollectingError if they are broken or too large or, if images use them, missing, and OSError.
    """
    names: tuple[str, ...] = ()
    if _own_bytes(folder / DATA, MAX_FILE_BYTES) is not None:
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
