"""The plan for many recordings, the result of each, and the record that says it is finished."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError

from yolov5_lifecycle.checkpoints.locate import weights_digest
from yolov5_lifecycle.detection.prepared_model import weights_path
from yolov5_lifecycle.offline.export.exporting import Export
from yolov5_lifecycle.offline.recordings import METADATA, SourceRecording, is_storage
from yolov5_lifecycle.quantization.calibration_file import calibration_digest
from yolov5_lifecycle.settings.settings import Settings, validated

RECORD_NAME = "detect_bag.json"
_PLACE_OF_WEIGHTS = {"model_size", "weights", "weights_dir", "weights_dirs", "weights_sha256"}
"""Settings that say where the model is, not which one it is."""

State = Literal["done", "skipped", "failed"]


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

    def chosen(self, runtime: str, precision: str) -> Plan:
        """The plan with what the first worker has chosen."""
        return replace(self, settings=_changed(self.settings, runtime=runtime, precision=precision))


def plan_of(settings: Settings, output: Path, export: Export) -> Plan:
    """The plan for the model that `settings` select, as its file is now; raises WeightsError and OSError."""
    weights = Path(os.path.abspath(weights_path(settings)))  # noqa: PTH100
    digest = weights_digest(weights, sha256=settings.weights_sha256)
    calibration = calibration_digest(weights) if settings.precision == "int8" else None
    values = settings.model_dump(mode="json", exclude=_PLACE_OF_WEIGHTS)
    return Plan(
        output=output,
        export=export,
        settings=_changed(settings, weights=str(weights), weights_sha256=digest),
        settings_sha256=_sha256(
            json.dumps([values, asdict(export), calibration], sort_keys=True, default=str)
        ),
    )


def _changed(settings: Settings, **values: str) -> Settings:
    return validated({**settings.model_dump(mode="json"), **values})


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


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
    """Jumps back in time, at each of which tracking began again."""
    first_problem: str = ""
    """What was wrong with the first image that was rejected or failed."""
    seconds: float = 0.0
    runtime: str = ""
    detections: dict[str, NonNegativeInt] = {}
    """By class, for every class of the model; empty if the recording failed."""


class Record(BaseModel):
    """What a finished result was made from, and its row of the summary."""

    model_config = ConfigDict(frozen=True)

    weights_sha256: str
    settings_sha256: str
    recording_sha256: str
    """See `recording_digest`."""
    result: RecordingResult

    def write(self, folder: Path) -> None:
        (folder / RECORD_NAME).write_text(self.model_dump_json(indent=1) + "\n", encoding="utf-8")


def finished_before(source: SourceRecording, plan: Plan) -> RecordingResult | None:
    """The row of a recording whose result was made from the same; None if there is none."""
    try:
        record = Record.model_validate_json((plan.output / source.name / RECORD_NAME).read_bytes())
        digest = recording_digest(source.path)
    except (OSError, ValidationError):
        return None
    wanted = plan.settings.weights_sha256, plan.settings_sha256, digest
    if (record.weights_sha256, record.settings_sha256, record.recording_sha256) != wanted:
        return None
    return record.result.model_copy(update={"state": "skipped", "path": str(source.path)})


def recording_digest(recording: Path) -> str:
    """Digest of name, size and time of the last change of each file of a recording; raises OSError."""
    files = [recording]
    if recording.is_dir():
        files = sorted(path for path in recording.iterdir() if is_storage(path) or path.name == METADATA)
    return _sha256(repr([(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]))
