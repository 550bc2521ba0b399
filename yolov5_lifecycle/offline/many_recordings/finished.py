"""Which results are finished: each has a record of the model, the settings and the recording behind it."""

from __future__ import annotations

import hashlib
import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from yolov5_lifecycle.atomic_file import write_whole
from yolov5_lifecycle.folder_listing import FolderTree
from yolov5_lifecycle.input_file import RegularFileError, read_regular_file
from yolov5_lifecycle.offline.many_recordings.plan import Plan
from yolov5_lifecycle.offline.many_recordings.recording_result import RecordingResult
from yolov5_lifecycle.offline.recordings import METADATA, SourceRecording, is_storage

RECORD_NAME = "detect_bag.json"
_MAX_RECORD_BYTES = 16 << 20
_BLOCK_BYTES = 1 << 20
_MAX_NAME = 4 * 255
"""A name of 255 bytes that are no text has 4 letters for each."""

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
FileName = Annotated[str, Field(min_length=1, max_length=_MAX_NAME)]
Bytes = Annotated[int, Field(ge=0, lt=1 << 63)]
FileStamp = tuple[FileName, Bytes, Annotated[int, Field(gt=-(1 << 63), lt=1 << 63)]]
"""Name, size in bytes and time of the last change in nanoseconds."""


class Record(BaseModel):
    """What a result was made from, its files, and its row of the summary."""

    model_config = ConfigDict(frozen=True, strict=True, extra="forbid")

    weights_sha256: Digest
    settings_sha256: Digest
    recording_sha256: Digest
    recording_files: tuple[FileStamp, ...]
    result_bytes: Annotated[dict[FileName, Bytes], Field(min_length=1)]
    """Size of each of its files."""
    result: RecordingResult

    @field_validator("result")
    @classmethod
    def _is_done(cls, value: RecordingResult) -> RecordingResult:
        if value.state != "done":
            raise ValueError("expected the row of a recording that is done")
        return value

    def is_of(self, plan: Plan, folder: Path) -> bool:
        """Whether the result in `folder` is whole and was made with the model and settings of `plan`."""
        same = (self.weights_sha256, self.settings_sha256) == (plan.weights_sha256, plan.settings_sha256)
        return same and self.result_bytes.items() <= result_bytes(folder).items()

    def added(self, folder: Path) -> list[str]:
        """Names of files that were added to the `folder` of the result since; raises OSError."""
        return sorted(result_bytes(folder).keys() - self.result_bytes.keys())

    def write(self, folder: Path) -> None:
        """Write the record into the `folder` of its result; raises OSError."""
        write_whole(folder / RECORD_NAME, self.model_dump_json(indent=1).encode() + b"\n", is_durable=False)


def read_record(folder: Path) -> Record | None:
    """The record of the result in `folder`; None if there is none that is valid and of that name."""
    try:
        record = Record.model_validate_json(read_regular_file(folder / RECORD_NAME, _MAX_RECORD_BYTES))
    except (OSError, RegularFileError, ValidationError):
        return None
    return record if record.result.recording == folder.name else None


def result_bytes(folder: Path) -> dict[str, int]:
    """Size of each file of the result in `folder`, without the record; raises OSError."""
    return {path.name: _size(path) for path in sorted(folder.iterdir()) if path.name != RECORD_NAME}


def _size(path: Path) -> int:
    """Size of a file, or of all files below a folder such as that of crops."""
    if path.is_dir() and not path.is_symlink():
        return sum(file.lstat().st_size for file in FolderTree().files(path))
    return path.lstat().st_size


def finished_before(source: SourceRecording, plan: Plan) -> RecordingResult | None:
    """The row of a recording that already has a result, if its files have not been changed since.

    Reads no content: a file of the same name, size and time of change counts as the same.
    """
    folder = plan.output / source.name
    try:
        record = read_record(folder)
        if record is None or not record.is_of(plan, folder):
            return None
        return skipped(record, source) if record.recording_files == file_stamps(source.path) else None
    except OSError:
        return None


def skipped(record: Record, source: SourceRecording) -> RecordingResult:
    """The row of the finished result of `source`."""
    return record.result.model_copy(update={"state": "skipped", "path": str(source.path)})


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
