"""The plan for many recordings, the result of each, and the record that says it is finished."""

from __future__ import annotations

import hashlib
import json
import os
import stat
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError

from yolov5_lifecycle.atomic_file import OutputError, atomic_write
from yolov5_lifecycle.checkpoints.locate import weights_digest
from yolov5_lifecycle.detection.prepared_model import weights_path
from yolov5_lifecycle.folder_listing import FolderTree
from yolov5_lifecycle.offline.export.exporting import Export
from yolov5_lifecycle.offline.recordings import METADATA, SourceRecording, is_storage
from yolov5_lifecycle.quantization.calibration_file import calibration_digest
from yolov5_lifecycle.settings.settings import Settings, validated

RECORD_NAME = "detect_bag.json"
_BLOCK_BYTES = 1 << 20
_PLACE_OF_WEIGHTS = {"model_size", "weights", "weights_dir", "weights_dirs", "weights_sha256"}
"""Settings that say where the model is, not which one it is."""

State = Literal["done", "skipped", "failed"]
COUNTED = ("images", "detected", "rejected", "failed", "missing", "late", "jumps")
"""Columns of a row that are summed up for all recordings."""
FileStamp = tuple[str, int, int]
"""Name, size in bytes and time of the last change in nanoseconds."""


@dataclass(frozen=True)
class Plan:
    """The model and the settings for all recordings, and the folder of their results."""

    output: Path
    export: Export
    """Of each recording, to paths that are relative to its result; "" as suffix: JSON lines of a video."""
    settings: Settings
    """They select the weights by absolute path and digest."""
    settings_sha256: str
    """Digest of everything but model and recording that the results depend on."""
    is_open: bool
    """Whether the runtime depends on what is measured."""

    def chosen(self, runtime: str, precision: str) -> Plan:
        """The plan with what the first worker has chosen."""
        return replace(
            self, settings=_changed(self.settings, runtime=runtime, precision=precision), is_open=False
        )


def plan_of(settings: Settings, output: Path, export: Export) -> Plan:
    """The plan for the model that `settings` select, as its file is now; raises WeightsError and OSError."""
    weights = Path(os.path.abspath(weights_path(settings)))  # noqa: PTH100
    digest = weights_digest(weights, sha256=settings.weights_sha256)
    calibration = calibration_digest(weights) if settings.precision == "int8" else None
    values = settings.model_dump(mode="json", exclude=_PLACE_OF_WEIGHTS)
    text = json.dumps([values, asdict(export), calibration], sort_keys=True, default=str)
    return Plan(
        output=output,
        export=export,
        settings=_changed(settings, weights=str(weights), weights_sha256=digest),
        settings_sha256=hashlib.sha256(text.encode()).hexdigest(),
        is_open=settings.runtime == "auto",
    )


def _changed(settings: Settings, **values: str) -> Settings:
    return validated({**settings.model_dump(mode="json"), **values})


class RecordingResult(BaseModel):
    """A row of the summary."""

    model_config = ConfigDict(frozen=True)

    recording: str
    """Its name, also the name of its result."""
    path: str
    state: State
    """Skipped: it already had a result; the rest of the row is from the run that wrote it."""
    reason: str = ""
    """Why the recording failed."""
    images: NonNegativeInt = 0
    detected: NonNegativeInt = 0
    rejected: NonNegativeInt = 0
    failed: NonNegativeInt = 0
    missing: NonNegativeInt = 0
    """Images that the recording claims and does not have."""
    late: NonNegativeInt = 0
    """Images that were not tracked, because a newer one had been."""
    jumps: NonNegativeInt = 0
    """Jumps back in time, at each of which tracking began anew."""
    first_problem: str = ""
    """What was wrong with the first image that was rejected or failed."""
    seconds: float = 0.0
    runtime: str = ""
    detections: dict[str, NonNegativeInt] = {}
    """By class, for every class of the model; empty if the recording failed."""


@dataclass(frozen=True)
class Refused:
    """Instead of a result: the model cannot be loaded, or no result can be written."""

    reason: str


class Record(BaseModel):
    """What a finished result was made from, its files, and its row of the summary."""

    model_config = ConfigDict(frozen=True)

    weights_sha256: str
    settings_sha256: str
    recording_sha256: str
    recording_files: tuple[FileStamp, ...]
    result_bytes: dict[str, int]
    """Size of each of its files."""
    result: RecordingResult

    def is_of(self, plan: Plan, folder: Path) -> bool:
        """Whether the result in `folder` is whole and was made with the model and settings of `plan`."""
        wanted = (plan.settings.weights_sha256, plan.settings_sha256)
        same = (self.weights_sha256, self.settings_sha256) == wanted
        return same and self.result_bytes.items() <= result_bytes(folder).items()

    def write(self, folder: Path) -> None:
        atomic_write(folder / RECORD_NAME, self.model_dump_json(indent=1).encode() + b"\n", is_durable=False)


def read_record(folder: Path) -> Record | None:
    """The record of the result in `folder`; None if there is none that is valid and of that name."""
    try:
        record = Record.model_validate_json((folder / RECORD_NAME).read_bytes())
    except (OSError, ValidationError):
        return None
    return record if record.result.recording == folder.name else None


def finished_before(
    source: SourceRecording, plan: Plan, *, by_content: bool = False
) -> RecordingResult | None:
    """The row of a recording that already has a result, if its files have not been changed since.

    A file of the same name, size and time of change counts as the same. With `by_content`, others are read,
    and if they are the same, the record gets their new stamps.
    """
    folder = plan.output / source.name
    try:
        record = read_record(folder)
        if record is None or not record.is_of(plan, folder):
            return None
        files = file_stamps(source.path)
        if files != record.recording_files:
            if not by_content or content_sha256(source.path) != record.recording_sha256:
                return None
            record.model_copy(update={"recording_files": files}).write(folder)
    except OSError:
        return None
    return record.result.model_copy(update={"state": "skipped", "path": str(source.path)})


def is_replaceable(folder: Path) -> bool:
    """Whether `folder` is an earlier result, False if it does not exist.

    Raises OutputError if it has something that is not of `detect_bag`, and OSError.
    """
    record = read_record(folder)
    if record is None:
        if folder.exists():
            raise OutputError(f"{folder} exists and has no record of detect_bag: move or remove it.")
        return False
    if added := sorted(result_bytes(folder).keys() - record.result_bytes.keys()):
        raise OutputError(
            f"{folder} is not replaced because it also contains {', '.join(added)}: move that elsewhere."
        )
    return True


def result_bytes(folder: Path) -> dict[str, int]:
    """Size of each file of the result in `folder`, without the record; raises OSError."""
    return {path.name: _size(path) for path in sorted(folder.iterdir()) if path.name != RECORD_NAME}


def _size(path: Path) -> int:
    """Size of a file, or of all files below a folder such as that of crops."""
    if path.is_dir() and not path.is_symlink():
        return sum(file.lstat().st_size for file in FolderTree().files(path))
    return path.lstat().st_size


def file_stamps(recording: Path) -> tuple[FileStamp, ...]:
    """Stamps of the files of a recording; raises OSError."""
    return tuple(_stamp(path) for path in _files(recording))


def content_sha256(recording: Path) -> str:
    """Digest of the names and the whole content of the files of a recording; raises OSError."""
    digest = hashlib.sha256()
    for path in _files(recording):
        digest.update(f"{_text(path.name)}\0".encode())
        digest.update(_file_digest(path))
    return digest.hexdigest()


def _files(recording: Path) -> Iterable[Path]:
    if not recording.is_dir():
        return [recording]
    return sorted(path for path in recording.iterdir() if is_storage(path) or path.name == METADATA)


def _stamp(path: Path) -> FileStamp:
    status = path.stat()
    return _text(path.name), status.st_size, status.st_mtime_ns


def _text(name: str) -> str:
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def _file_digest(path: Path) -> bytes:
    digest = hashlib.sha256()
    # A pipe would block forever.
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(f"{path.name} is not a regular file")
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.digest()
