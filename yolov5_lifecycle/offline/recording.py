"""The images in a rosbag2 recording."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader, StoragePlugin
from rosbags.rosbag2.reader import DirectoryReader
from rosbags.serde import SerdeError

from yolov5_lifecycle.images import ImageError, Picture
from yolov5_lifecycle.message_pictures import compressed_picture, raw_picture
from yolov5_lifecycle.offline.recorded_types import TYPES

_RAW = "sensor_msgs/msg/Image"
_COMPRESSED = "sensor_msgs/msg/CompressedImage"


class RecordingError(ValueError):
    """A recording that cannot be read or has not what was asked for; says what it has."""


@dataclass(frozen=True)
class RecordedImage:
    """An image message as it was recorded, and when that was."""

    timestamp_ns: int
    type_name: str
    data: bytes

    @property
    def label(self) -> str:
        return f"{self.timestamp_ns // 10**9}.{self.timestamp_ns % 10**9:09}"

    @cached_property
    def message(self) -> Any:
        """The message, an object of rosbags; raises ImageError."""
        try:
            return TYPES.deserialize_cdr(self.data, self.type_name)
        except SerdeError as error:
            raise ImageError(
                f"Expected a message of {self.type_name}, found other bytes ({error})."
            ) from None

    def load(self) -> Picture:
        decode = compressed_picture if self.type_name == _COMPRESSED else raw_picture
        return decode(self.message)


@dataclass(frozen=True)
class ImageTopic:
    """A topic with images and how many messages it has."""

    name: str
    type_name: str
    count: int
    connections: tuple[Connection, ...]


class Recording:
    """An open recording; see `open_recording`."""

    def __init__(self, path: Path, reader: Reader) -> None:
        self._path = path
        self._reader = reader

    @property
    def storage(self) -> StoragePlugin:
        """What its files are."""
        files = [self._path] if self._path.is_file() else list(self._path.iterdir())
        is_mcap = any(".mcap" in file.suffixes for file in files)
        return StoragePlugin.MCAP if is_mcap else StoragePlugin.SQLITE3

    def image_topic(self, name: str | None = None) -> ImageTopic:
        """The image topic called `name`, or the only one; raises RecordingError with those that there are."""
        topics = self._image_topics()
        wanted = [topic for topic in topics if name in (None, topic.name)]
        if len(wanted) == 1:
            return wanted[0]
        listing = "".join(f"\n  {topic.name}  {topic.type_name}  {topic.count}" for topic in topics)
        if not topics:
            others = ", ".join(sorted({one.topic for one in self._connections()})) or "nothing"
            raise RecordingError(
                f"{self._path}: there are no images ({_RAW} or {_COMPRESSED}) in it, only: {others}. "
                "Record the topic of the camera."
            )
        if name is None:
            raise RecordingError(f"{self._path}: say with --topic which of its image topics:{listing}")
        raise RecordingError(f"{self._path}: there is no image topic {name}; name one of these:{listing}")

    def images(self, topic: ImageTopic) -> Iterator[RecordedImage]:
        """Every message of `topic` in the order of recording; raises RecordingError at a damage."""
        messages = self._reader.messages(topic.connections)
        while True:
            with _readable(self._path):
                found = next(messages, None)
            if found is None:
                return
            _, timestamp_ns, data = found
            yield RecordedImage(timestamp_ns, topic.type_name, data)

    def _image_topics(self) -> list[ImageTopic]:
        by_topic: dict[tuple[str, str], list[Connection]] = {}
        for connection in self._connections():
            if connection.msgtype in (_RAW, _COMPRESSED):
                by_topic.setdefault((connection.topic, connection.msgtype), []).append(connection)
        return [
            ImageTopic(name, type_name, sum(one.msgcount for one in connections), tuple(connections))
            for (name, type_name), connections in sorted(by_topic.items())
        ]

    def _connections(self) -> list[Connection]:
        """Those of the files: rosbags leaves out what metadata.yaml describes otherwise than they do."""
        storage = self._reader.storage
        files = storage.storages if isinstance(storage, DirectoryReader) else [storage]
        return [connection for file in files for connection in file.connections]


@contextmanager
def open_recording(path: Path) -> Iterator[Recording]:
    """The recording at `path`: the folder that ros2 bag makes, or one of its .mcap and .db3 files.

    Raises RecordingError.
    """
    with ExitStack() as stack:
        with _readable(path):
            reader = stack.enter_context(Reader(path))
        yield Recording(path, reader)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(
            f"{path}: the recording cannot be read: {reason.removesuffix('.')}. "
            "If its end is missing, `ros2 bag reindex` or `mcap recover` may mend it."
        ) from error
