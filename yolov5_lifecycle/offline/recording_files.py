"""The files of a rosbag2 recording: named by metadata.yaml, and unpacked if they are packed as a whole."""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path, PurePath

from backports import zstd

from yolov5_lifecycle.input_file import read_regular_file
from yolov5_lifecycle.offline.mcap_file import McapFile
from yolov5_lifecycle.offline.recordings import METADATA, PACKED, ROS1_BAG
from yolov5_lifecycle.offline.sqlite_file import SqliteFile
from yolov5_lifecycle.offline.stored_topics import MAX_MESSAGE_BYTES, Storage, StorageError
from yolov5_lifecycle.outside_yaml import texts_of
from yolov5_lifecycle.printable import shell_command

MAX_METADATA_BYTES = 16 << 20
_FREE_SHARE = 0.9
_BLOCK_BYTES = 1 << 20
_DIGITS = 15
"""Of a number of messages that is taken for one."""
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""A message of ROS 2 begins with a zero."""
_FORMATS: Mapping[str, Callable[[Path], Storage]] = {".mcap": McapFile, ".db3": SqliteFile}


@dataclass(frozen=True)
class RecordingFiles:
    """Names of the files in the folder of a recording, in their order, and what is known of them."""

    paths: tuple[Path, ...]
    claimed: Mapping[str, int] = field(default_factory=dict)
    """Messages of each topic, as metadata.yaml says."""


def files_of(path: Path) -> RecordingFiles:
    """The files of the recording at `path`, a folder or one file. Raises StorageError and OSError."""
    if not path.is_dir():
        return RecordingFiles((path,))
    try:
        described = texts_of(read_regular_file(path / METADATA, MAX_METADATA_BYTES))
    except FileNotFoundError:
        raise StorageError(
            f"{METADATA} is missing, which is written when recording ends: "
            f"{shell_command('ros2', 'bag', 'reindex', path)}"
        ) from None
    except ValueError as error:
        raise StorageError(f"{METADATA}: {error}") from None
    bag = _mapping(_mapping(described).get("rosbag2_bagfile_information"))
    names = bag.get("relative_file_paths")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise StorageError(f"{METADATA} has no list relative_file_paths")
    # Written with the folder in front by early versions; a file elsewhere is not read.
    return RecordingFiles(tuple(path / PurePath(name).name for name in names), _claimed(bag))


def _claimed(bag: Mapping[str, object]) -> Counter[str]:
    counts: Counter[str] = Counter()
    topics = bag.get("topics_with_message_count")
    for topic in map(_mapping, topics if isinstance(topics, list) else []):
        name, count = _mapping(topic.get("topic_metadata")).get("name"), topic.get("message_count")
        if isinstance(name, str) and isinstance(count, str) and count.isdecimal() and len(count) <= _DIGITS:
            counts[name] += int(count)
    return counts


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, dict) else {}


def open_storage(path: Path, stack: ExitStack) -> Storage:
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
    storage = new(path)
    stack.callback(storage.close)
    return storage


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


def unpacked_message(data: bytes) -> bytes | None:
    """`data`, unpacked if the recorder has packed the message; None if larger than MAX_MESSAGE_BYTES."""
    if not data.startswith(_ZSTD_MAGIC):
        return data
    try:
        content = zstd.ZstdDecompressor().decompress(data, MAX_MESSAGE_BYTES + 1)
    except zstd.ZstdError:  # damaged, as the message will be
        return data
    return content if len(content) <= MAX_MESSAGE_BYTES else None
