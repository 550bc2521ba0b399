"""The recordings and videos that a command processes: given by path, or as a folder of them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.folder_listing import entries
from yolov5_lifecycle.offline.image_files import is_image
from yolov5_lifecycle.printable import is_utf8
from yolov5_lifecycle.sources.frames import SourceError

METADATA = "metadata.yaml"
ROS1_BAG = ".bag"
PACKED = ".zstd"
_SUFFIXES = (".mcap", ".db3")
_VIDEO_SUFFIXES = (
    *(".3gp", ".avi", ".flv", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4"),
    *(".mpeg", ".mpg", ".ogv", ".webm", ".wmv"),
)


@dataclass(frozen=True)
class SourceRecording:
    """A recording or video at an absolute `path`, and the name of its result."""

    name: str
    path: Path


def is_recording(path: Path) -> bool:
    """Whether `path` has the name of a recording, or is a folder that contains files of rosbag2.

    A bag of ROS 1 counts: opening it says how to convert it.
    """
    if not path.is_dir():
        return is_storage(path) or path.suffix == ROS1_BAG
    return any(map(is_storage, entries(path)))


def is_video(path: Path) -> bool:
    """Whether `path` is a file with the name of a video."""
    return path.suffix.lower() in _VIDEO_SUFFIXES and path.is_file()


def is_storage(path: Path) -> bool:
    """Whether `path` has the name of a rosbag2 file, possibly compressed."""
    return Path(path.name.removesuffix(PACKED)).suffix in _SUFFIXES


def are_many(sources: Sequence[Path]) -> bool:
    """Whether `sources` stand for many recordings or videos: several paths or a folder of them."""
    return len(sources) > 1 or any(map(_has_recordings, sources))


def recordings_of(sources: Iterable[Path], output: Path) -> list[SourceRecording]:
    """The recordings and videos that `sources` stand for, each once, in order.

    Raises SourceError for a source without any or in the folder `output`, for two of the same name, and for a
    name that is reserved or not UTF-8.
    """
    absolute = (Path(os.path.abspath(source)) for source in sources)  # noqa: PTH100 - without `..`
    paths = dict.fromkeys(path for source in absolute for path in _expanded(source, output))
    found = [SourceRecording(_name(path), path) for path in paths]
    _check_names(found)
    return found


def _expanded(source: Path, output: Path) -> list[Path]:
    """`source`, or the recordings and videos in that folder."""
    if Path(os.path.realpath(source)).is_relative_to(os.path.realpath(output)):
        raise SourceError(f"{source}: it is in the folder of results {output}: choose another --output.")
    found = _children(source) if _has_recordings(source) else [source] if _may_be_recording(source) else []
    if not found:
        raise SourceError(
            f"{source}: expected ros2 bag recordings (.mcap, .db3) or videos ({', '.join(_VIDEO_SUFFIXES)}), "
            "found none. A folder of images is a source of its own: give it alone, without --jobs."
        )
    return found


def _has_recordings(path: Path) -> bool:
    """Whether `path` is a folder of recordings or videos, and neither a recording nor a folder of images."""
    if not path.is_dir() or (path / METADATA).exists():
        return False
    files = list(entries(path))
    if any(map(is_storage, files)):  # a single file without metadata is a damaged recording
        return len(_children(path)) > 1
    return not any(map(is_image, files)) and bool(_children(path))


def _children(folder: Path) -> list[Path]:
    return sorted(path for path in entries(folder) if path.name[0] != "." and _may_be_recording(path))


def _may_be_recording(path: Path) -> bool:
    """Whether it looks like one; true for a folder that cannot be listed: reading it will report why."""
    try:
        return is_video(path) or is_recording(path)
    except OSError:
        return True


def _name(path: Path) -> str:
    """Name of the folder, or of the file without the extensions of its format."""
    if path.is_dir():
        return path.name
    name = path.name.removesuffix(PACKED)
    return name[: -len(Path(name).suffix)] or path.name


def _check_names(found: Sequence[SourceRecording]) -> None:
    by_name: dict[str, SourceRecording] = {}
    for recording in found:
        if (other := by_name.setdefault(recording.name, recording)) is not recording:
            raise SourceError(
                f"{other.path} and {recording.path}: their results would have the same name; use a separate "
                "run and --output for each, or rename one."
            )
        is_reserved = recording.name.startswith("summary.") or not recording.name.strip(".")
        if is_reserved or not is_utf8(str(recording.path)):
            raise SourceError(f"{recording.path}: its result cannot have that name; rename the recording.")
