"""Images in rosbag2 recordings, and the message types to read and write them without ROS."""

from __future__ import annotations

import itertools
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

from backports import zstd
from pydantic import BaseModel, Field, ValidationError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from yolov5_lifecycle.images.compressed import compressed_image
from yolov5_lifecycle.images.encodings import raw_image
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.input_file import read_regular_file
from yolov5_lifecycle.offline.recordings import METADATA, PACKED, ROS1_BAG
from yolov5_lifecycle.offline.stored_messages import (
    CDR,
    MAX_MESSAGE_BYTES,
    McapFile,
    SqliteFile,
    StorageError,
    StoredTopic,
)
from yolov5_lifecycle.outside_yaml import texts_of
from yolov5_lifecycle.printable import in_one_line, shell_command

_RAW = "sensor_msgs/msg/Image"
_COMPRESSED = "sensor_msgs/msg/CompressedImage"

_VISION_MSGS = {
    "Point2D": "float64 x\nfloat64 y",
    "Pose2D": "vision_msgs/Point2D position\nfloat64 theta",
    "BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y",
    "ObjectHypothesis": "string class_id\nfloat64 score",
    "ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose",
    "Detection2D": "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\n"
    "vision_msgs/BoundingBox2D bbox\nstring id",
    "Detection2DArray": "std_msgs/Header header\nvision_msgs/Detection2D[] detections",
    "VisionClass": "uint16 class_id\nstring class_name",
    "LabelInfo": "std_msgs/Header header\nvision_msgs/VisionClass[] class_map\nfloat32 threshold",
}
"""Definitions by name, copied from interfaces/vision_msgs, which is not installed with this package."""


def _typestore() -> Typestore:
    """Built-in types only: rosbags turns type definitions of a recording into code, which is not executed."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in _VISION_MSGS.items():
        store.register(get_types_from_msg(definition, f"vision_msgs/msg/{name}"))
    return store


TYPES = _typestore()
"""Message types of Jazzy and vision_msgs."""
MAX_METADATA_BYTES = 16 << 20
_MAX_FILES = 10_000
_FREE_SHARE = 0.9
_BLOCK_BYTES = 1 << 20
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""A message of ROS 2 begins with a zero."""
_Storage = McapFile | SqliteFile
_FORMATS: Mapping[str, Callable[[Path, ExitStack], _Storage]] = {".mcap": McapFile, ".db3": SqliteFile}
_MAX_LISTED = 50
"""Topics in an error."""


class _BagInformation(BaseModel):
    relative_file_paths: list[str] = Field(max_length=_MAX_FILES)


class _Metadata(BaseModel):
    """The part of metadata.yaml that is read."""

    rosbag2_bagfile_information: _BagInformation


class RecordingError(ValueError):
    """A recording that cannot be read or lacks what was requested; the message lists what it has."""


@dataclass(frozen=True)
class RecordedMessage:
    """A recorded message with a header, its time stamp in the recording, and its number on its topic."""

    timestamp_ns: int
    type_name: str
    data: bytes | None
    """None if it is larger than MAX_MESSAGE_BYTES."""
    number: int

    @property
    def label(self) -> str:
        return f"{self.timestamp_ns // 10**9}.{self.timestamp_ns % 10**9:09}"

    @cached_property
    def message(self) -> Any:
        """The deserialized message, a rosbags object; raises ImageError, whatever the message is."""
        if self.data is None:
            raise ImageError(f"Expected a message of at most {MAX_MESSAGE_BYTES >> 20} MiB, found more.")
        try:
            return TYPES.deserialize_cdr(self.data, self.type_name)
        except Exception as error:  # noqa: BLE001 - rosbags wraps only some errors of damaged bytes
            raise ImageError(
                f"Expected a message of {self.type_name}, found other bytes ({in_one_line(str(error))})."
            ) from None

    @property
    def stamp(self) -> tuple[int, int]:
        """Seconds and nanoseconds in its header; raises ImageError."""
        stamp = self.message.header.stamp
        return int(stamp.sec), int(stamp.nanosec)

    @property
    def stamp_s(self) -> float:
        """Stamp of its header in seconds; raises ImageError."""
        seconds, nanoseconds = self.stamp
        return seconds + nanoseconds * 1e-9

    @property
    def identity(self) -> dict[str, str | int]:
        """The stamp of its header, which others may have, too, and its number; raises ImageError."""
        seconds, nanoseconds = self.stamp
        return {"stamp_ns": seconds * 10**9 + nanoseconds, "frame": self.number}

    @property
    def stem(self) -> str:
        """The name of files about it: its stamp, which others may have, and number; raises ImageError."""
        seconds, nanoseconds = self.stamp
        return f"{seconds}_{nanoseconds:09}_frame_{self.number:06}"

    def load(self) -> ColourImage:
        """The pixels of an image message; raises ImageError."""
        decode = compressed_image if self.type_name == _COMPRESSED else raw_image
        return decode(self.message)


@dataclass(frozen=True)
class Recording:
    """An open recording; see `open_recording`."""

    path: Path
    storages: Sequence[_Storage]

    def image_topic(self, name: str | None = None) -> StoredTopic:
        """The image topic `name`, or the only one; raises RecordingError with the available topics."""
        if not (topics := self.topics(_RAW, _COMPRESSED)):
            stored = {f"{topic.name} ({topic.type_name}, {topic.encoding})" for topic in self._stored()}
            others = in_one_line(", ".join(sorted(stored)) or "nothing")
            raise RecordingError(
                f"{self.path}: there are no images ({_RAW} or {_COMPRESSED}, {CDR}) in it, only: {others}. "
                "Record the image topic of the camera."
            )
        wanted = [topic for topic in topics if name in (None, topic.name)]
        if len(wanted) == 1:
            return wanted[0]
        listing = "".join(
            f"\n  {in_one_line(topic.name)}  {topic.type_name}  {topic.count}"
            for topic in topics[:_MAX_LISTED]
        )
        if name is None:
            raise RecordingError(f"{self.path}: choose one of its image topics with --topic:{listing}")
        raise RecordingError(f"{self.path}: there is no image topic {name}; choose one of these:{listing}")

    def messages(self, topic: StoredTopic) -> Iterator[RecordedMessage]:
        """Every message of `topic` in recording order; raises RecordingError if the file is damaged."""
        numbers = itertools.count()
        for storage in self.storages:
            messages = storage.messages(topic.name, topic.type_name)
            while True:
                with _readable(self.path):
                    if (found := next(messages, None)) is None:
                        break
                    timestamp_ns, data = found
                    data = data and _unpacked_message(data)
                yield RecordedMessage(timestamp_ns, topic.type_name, data, next(numbers))

    def topics(self, *type_names: str) -> list[StoredTopic]:
        """Its topics of these types, sorted by name."""
        counts: Counter[tuple[str, str]] = Counter()
        for topic in self._stored():
            if topic.type_name in type_names and topic.encoding == CDR:
                counts[topic.name, topic.type_name] += topic.count
        return [
            StoredTopic(name, type_name, CDR, count) for (name, type_name), count in sorted(counts.items())
        ]

    def _stored(self) -> Iterator[StoredTopic]:
        return (topic for storage in self.storages for topic in storage.topics)


@contextmanager
def open_recording(path: Path) -> Iterator[Recording]:
    """Open the recording at `path`: the folder created by ros2 bag, or one of its .mcap and .db3 files.

    Raises RecordingError.
    """
    with ExitStack() as stack:
        with _readable(path):
            storages = [_open_storage(file, stack) for file in _files_of(path)]
        yield Recording(path, storages)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        reason = in_one_line(str(error))[:500].removesuffix(".") or type(error).__name__
        is_refused = isinstance(error, StorageError)
        repair = "" if is_refused else " If its end is missing, `mcap recover` may repair it."
        raise RecordingError(f"{path}: the recording cannot be read: {reason}.{repair}") from error


def _files_of(path: Path) -> list[Path]:
    """The files of the recording at `path`, in order; raises StorageError and OSError."""
    if not path.is_dir():
        return [path]
    try:
        described = texts_of(read_regular_file(path / METADATA, MAX_METADATA_BYTES))
        bag = _Metadata.model_validate(described).rosbag2_bagfile_information
    except FileNotFoundError:
        raise StorageError(
            f"{METADATA} is missing, which is written when recording ends: "
            f"{shell_command('ros2', 'bag', 'reindex', path)}"
        ) from None
    except ValidationError as error:
        problem = error.errors()[0]
        raise StorageError(f"{METADATA}: {'.'.join(map(str, problem['loc']))}: {problem['msg']}") from None
    except ValueError as error:
        raise StorageError(f"{METADATA}: {error}") from None
    # Written with the folder in front by early versions; a file elsewhere is not read.
    return [path / PurePath(name).name for name in bag.relative_file_paths]


def _open_storage(path: Path, stack: ExitStack) -> _Storage:
    """The file at `path`, which `stack` closes. Raises an exception of any kind if it is damaged."""
    if not path.is_file():
        found = "is not a regular file" if path.exists() else "is missing"
        raise StorageError(f"{path.name} {found}")
    if path.suffix == PACKED:
        path = _unpacked(path, Path(stack.enter_context(tempfile.TemporaryDirectory())))
    if path.suffix == ROS1_BAG:
        command = shell_command("rosbags-convert", "--src", path, "--dst", path.with_suffix(""))
        raise StorageError(f"it is a bag of ROS 1. Convert it: {command}")
    if (new := _FORMATS.get(path.suffix)) is None:
        raise StorageError(f"{path.name}: expected a name that ends in {' or '.join(_FORMATS)}")
    return new(path, stack)


def _unpacked(packed: Path, folder: Path) -> Path:
    """The file `packed` in `folder`; raises StorageError if it would fill the disk."""
    path = folder / packed.stem
    left = int(shutil.disk_usage(folder).free * _FREE_SHARE)
    with zstd.open(packed, "rb") as source, path.open("wb") as target:
        while block := source.read(_BLOCK_BYTES):
            if (left := left - len(block)) < 0:
                raise StorageError(
                    f"{packed.name} unpacks to more than {_FREE_SHARE:.0%} of what is free in "
                    f"{folder.parent}: free some, or set TMPDIR to another disk"
                )
            target.write(block)
    return path


def _unpacked_message(data: bytes) -> bytes | None:
    """`data`, unpacked if the recorder has packed the message; None if larger than MAX_MESSAGE_BYTES."""
    if not data.startswith(_ZSTD_MAGIC):
        return data
    try:
        content = zstd.ZstdDecompressor().decompress(data, MAX_MESSAGE_BYTES + 1)
    except zstd.ZstdError:  # damaged, as the message will be
        return data
    return content if len(content) <= MAX_MESSAGE_BYTES else None
