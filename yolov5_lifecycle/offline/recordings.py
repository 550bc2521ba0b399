"""The recordings and videos that a command processes: given by path, by pattern, or as a folder of them."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from yolov5_lifecycle.folder_listing import MAX_ENTRIES, entries
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
_WILDCARDS = "*?["
_MAX_TOLD = 5


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
    """Whether `sources` stand for many recordings or videos: several paths, a pattern or a folder of them."""
    return len(sources) > 1 or any(_matches(source) or _has_recordings(source) for source in sources)


def recordings_of(sources: Iterable[Path], output: Path) -> list[SourceRecording]:
    """The recordings and videos that `sources` stand for, each once, in order; none in the folder `output`.

    Raises SourceError for a source without any, for two of the same name, and for a name that is reserved or
    not UTF-8.
    """
    paths = {Path(os.path.abspath(path)): None for source in sources for path in _expanded(source, output)}  # noqa: PTH100
    # `**` matches a recording and its files.
    found = [SourceRecording(_name(path), path) for path in paths if path.parent not in paths]
    _check_names(found)
    return found


def _expanded(source: Path, output: Path) -> list[Path]:
    if matches := _matches(source):
        found = [path for match in matches for path in _recordings_at(match)]
    elif source.exists():
        found = list(_recordings_at(source))
    else:
        raise SourceError(f"{source}: file or folder not found")
    own = Path(os.path.realpath(output))
    others = [path for path in found if not Path(os.path.realpath(path)).is_relative_to(own)]
    if found and not others:
        raise SourceError(
            f"{source}: all its recordings are in the folder of results {output}: choose another --output."
        )
    if not found:
        raise SourceError(
            f"{source}: expected ros2 bag recordings (.mcap, .db3) or videos ({', '.join(_VIDEO_SUFFIXES)}), "
            "found none. A folder of images is a source of its own: give it alone, without --jobs and --ray."
        )
    return others


def _recordings_at(path: Path) -> Iterator[Path]:
    """`path`, or the recordings and videos in that folder."""
    if _has_recordings(path):
        yield from _children(path)
    elif _may_be_recording(path):
        yield path


def _matches(path: Path) -> list[Path]:
    """The paths that match `path` as a pattern; none if a file has this very name."""
    if os.path.lexists(path) or not any(wildcard in str(path) for wildcard in _WILDCARDS):
        return []
    found = list(islice(glob.iglob(str(path), recursive=True), MAX_ENTRIES + 1))  # noqa: PTH207
    if len(found) > MAX_ENTRIES:
        raise SourceError(
            f"{path}: expected at most {MAX_ENTRIES:,} matches, found more: narrow the pattern."
        )
    return list(map(Path, sorted(found)))


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
    by_name: dict[str, list[Path]] = {}
    for recording in found:
        by_name.setdefault(recording.name, []).append(recording.path)
    same = [paths for paths in by_name.values() if len(paths) > 1]
    if same:
        told = "".join(f"\n  {', '.join(map(str, paths[:_MAX_TOLD]))}" for paths in same[:_MAX_TOLD])
        raise SourceError(
            f"{len(same)} name(s) belong to several recordings or videos, so their results would have the "
            f"same name; use a separate run and --output for each, or rename them:{told}"
        )
    for recording in found:
        is_reserved = recording.name.startswith("summary.") or not recording.name.strip(".")
        if is_reserved or not is_utf8(str(recording.path)):
            raise SourceError(f"{recording.path}: its result cannot have that name; rename the recording.")
