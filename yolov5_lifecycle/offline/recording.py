"""Images in rosbag2 recordings, and the message types to read and write them without ROS."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import StoragePlugin
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from yolov5_lifecycle.images.compressed import compressed_image
from yolov5_lifecycle.images.encodings import raw_image
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.offline.distinct_names import DistinctNames
from yolov5_lifecycle.offline.recording_files import files_of, open_storage, unpacked_message
from yolov5_lifecycle.offline.recordings import is_mcap
from yolov5_lifecycle.offline.stored_topics import (
    CDR,
    MAX_MESSAGE_BYTES,
    DamageError,
    Storage,
    StorageError,
    StoredTopic,
)
from yolov5_lifecycle.printable import in_one_line

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


_MAX_LISTED = 50
"""Topics in an error."""
Stamp = tuple[int, int]
"""Seconds and nanoseconds in the header."""


class RecordingError(ValueError):
    """A recording that cannot be read or lacks what was requested; the message lists what it has."""


@dataclass(frozen=True)
class RecordedMessage:
    """A recorded message with a header, and its time stamp in the recording."""

    timestamp_ns: int
    type_name: str
    data: bytes | None
    """None if it is larger than MAX_MESSAGE_BYTES."""

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
    def stamp(self) -> Stamp:
        """Of its header; raises ImageError."""
        stamp = self.message.header.stamp
        return int(stamp.sec), int(stamp.nanosec)

    @property
    def stamp_s(self) -> float:
        """Stamp of its header in seconds; raises ImageError."""
        seconds, nanoseconds = self.stamp
        return seconds + nanoseconds * 1e-9


@dataclass(frozen=True)
class RecordedImage(RecordedMessage):
    """A recorded image message, counted from 0 on its topic, and the names of those before it."""

    frame: int = field(default=0, kw_only=True)
    names: DistinctNames = field(default_factory=DistinctNames, kw_only=True)

    @property
    def identity(self) -> dict[str, str | int]:
        """The stamp of its header, which others may have, too, and its number; raises ImageError."""
        seconds, nanoseconds = self.stamp
        return {"stamp_ns": seconds * 10**9 + nanoseconds, "frame": self.frame}

    @property
    def stem(self) -> str:
        """The name of files about it: its stamp, and its number if one before has it; ask in order."""
        seconds, nanoseconds = self.stamp
        return self.names.of(f"{seconds}_{nanoseconds:09}", self.frame)

    def load(self) -> ColourImage:
        decode = compressed_image if self.type_name == _COMPRESSED else raw_image
        return decode(self.message)


@dataclass(frozen=True)
class RecordedTopic:
    """A topic and its number of messages, as the recording claims; a damaged one may have fewer."""

    name: str
    type_name: str
    count: int


class Recording:
    """An open recording; see `open_recording`."""

    def __init__(self, path: Path, storages: Sequence[Storage], claimed: Mapping[str, int]) -> None:
        self.path = path
        self._storages = storages
        self._claimed = claimed

    @property
    def storage(self) -> StoragePlugin:
        """The storage format of its files."""
        return StoragePlugin.MCAP if is_mcap(self.path) else StoragePlugin.SQLITE3

    def image_topic(self, name: str | None = None) -> RecordedTopic:
        """The image topic `name`, or the only one; raises RecordingError with the available topics."""
        if not (topics := self.topics(_RAW, _COMPRESSED)):
            others = in_one_line(", ".join(sorted({topic.name for topic in self._stored()})) or "nothing")
            raise RecordingError(
                f"{self.path}: there are no images ({_RAW} or {_COMPRESSED}) in it, only: {others}. "
                "Record the image topic of the camera."
            )
        return self.one_of(topics, name, what="image topic", option="--topic")

    def one_of(
        self, topics: Sequence[RecordedTopic], name: str | None, *, what: str, option: str
    ) -> RecordedTopic:
        """The topic `name`, or the only one; raises RecordingError, which names the `option` to choose."""
        wanted = [topic for topic in topics if name in (None, topic.name)]
        if len(wanted) == 1:
            return wanted[0]
        listing = "".join(
            f"\n  {in_one_line(topic.name)}  {topic.type_name}  {topic.count}"
            for topic in topics[:_MAX_LISTED]
        )
        if name is None:
            raise RecordingError(f"{self.path}: choose one of its {what}s with {option}:{listing}")
        raise RecordingError(f"{self.path}: there is no {what} {name}; choose one of these:{listing}")

    def images(self, topic: RecordedTopic) -> Iterator[RecordedImage]:
        """Every image of `topic` in recording order; raises RecordingError if the file is damaged."""
        names = DistinctNames()
        return (
            RecordedImage(*message, frame=frame, names=names)
            for frame, message in enumerate(self._messages(topic))
        )

    def messages(self, topic: RecordedTopic) -> Iterator[RecordedMessage]:
        """Like `images` for any topic whose messages have a header."""
        return (RecordedMessage(*message) for message in self._messages(topic))

    def _messages(self, topic: RecordedTopic) -> Iterator[tuple[int, str, bytes | None]]:
        for storage in self._storages:
            messages = storage.messages(topic.name, topic.type_name)
            while True:
                with _readable(self.path):
                    if (found := next(messages, None)) is None:
                        break
                    timestamp_ns, data = found
                    data = data and unpacked_message(data)
                yield timestamp_ns, topic.type_name, data

    def topics(self, *type_names: str) -> list[RecordedTopic]:
        """Its topics of these types, sorted by name."""
        counts: Counter[tuple[str, str]] = Counter()
        for topic in self._stored():
            if topic.type_name in type_names and topic.encoding == CDR:
                counts[topic.name, topic.type_name] += topic.count
        return [
            RecordedTopic(name, type_name, max(count, self._claimed.get(name, 0)))
            for (name, type_name), count in sorted(counts.items())
        ]

    @property
    def foreign(self) -> str:
        """Topics whose messages are not those of ROS 2, with their encodings."""
        foreign = {f"{topic.name} ({topic.encoding})" for topic in self._stored() if topic.encoding != CDR}
        return in_one_line(", ".join(sorted(foreign)))

    def _stored(self) -> Iterator[StoredTopic]:
        return (topic for storage in self._storages for topic in storage.topics)


@contextmanager
def open_recording(path: Path) -> Iterator[Recording]:
    """Open the recording at `path`: the folder created by ros2 bag, or one of its .mcap and .db3 files.

    Raises RecordingError.
    """
    with ExitStack() as stack:
        with _readable(path):
            files = files_of(path)
            storages = [open_storage(file, stack) for file in files.paths]
        yield Recording(path, storages, files.claimed)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except RecordingError:
        raise
    except Exception as error:
        reason = in_one_line(str(error))[:500].removesuffix(".") or type(error).__name__
        is_refused = isinstance(error, StorageError) and not isinstance(error, DamageError)
        repair = "" if is_refused else " If its end is missing, `mcap recover` may repair it."
        raise RecordingError(f"{path}: the recording cannot be read: {reason}.{repair}") from error
