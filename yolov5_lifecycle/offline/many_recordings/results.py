"""The plan for many recordings, the result of each, the record that says it is finished, and the summary."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError

from yolov5_lifecycle.atomic_file import OutputError, atomic_write
from yolov5_lifecycle.checkpoints.locate import weights_digest
from yolov5_lifecycle.detection.prepared_model import weights_path
from yolov5_lifecycle.offline.detecting import RunStatistics
from yolov5_lifecycle.offline.export.exporting import Export
from yolov5_lifecycle.offline.recordings import METADATA, SourceRecording, is_storage
from yolov5_lifecycle.offline.terminal import report
from yolov5_lifecycle.quantization.calibration_file import calibration_digest
from yolov5_lifecycle.settings.settings import Settings, validated

RECORD_NAME = "detect_bag.json"
SUMMARY_NAME = "summary.json"
_BEGIN = b'{\n "weights": "'
_COUNTED = tuple(RunStatistics(0).counts)
"""Columns of a row that are summed up for all recordings."""
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
    return record.result.model_copy(
        update={"state": "skipped", "recording": source.name, "path": str(source.path)}
    )


def recording_digest(recording: Path) -> str:
    """Digest of name, size and time of the last change of each file of a recording; raises OSError."""
    files = [recording]
    if recording.is_dir():
        files = sorted(path for path in recording.iterdir() if is_storage(path) or path.name == METADATA)
    return _sha256(repr([(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]))


class Batch:
    """The results of a run over `count` recordings; `str` of it is a summary for the user."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.results: dict[str, RecordingResult] = {}
        self.begun_s = time.monotonic()
        """When the first model was loaded."""
        self._in_progress: dict[str, int] = {}

    def progress(self, recording: str, images: int) -> None:
        """So many images of `recording` are done; any thread may call it."""
        self._in_progress[recording] = images

    def add(self, result: RecordingResult) -> None:
        self._in_progress.pop(result.recording, None)
        self.results[result.recording] = result

    @property
    def images(self) -> int:
        """Images of this run, of unfinished recordings too."""
        done = (result.images for result in self.results.values() if result.state == "done")
        return sum(done) + sum(self._in_progress.values())

    @property
    def rate_hz(self) -> float:
        """Images per second of all workers together."""
        return self.images / max(time.monotonic() - self.begun_s, 1e-9)

    @property
    def is_complete(self) -> bool:
        """Whether every recording has a result with all its images."""
        return not any(result.state == "failed" or result.missing for result in self.results.values())

    @property
    def states(self) -> dict[str, int]:
        """How many recordings are in each state."""
        counts = Counter(result.state for result in self.results.values())
        return {state: counts[state] for state in get_args(State)}

    @property
    def counts(self) -> dict[str, int]:
        """The sum of each of the counted columns."""
        return {name: sum(getattr(row, name) for row in self.results.values()) for name in _COUNTED}

    @property
    def detections(self) -> Counter[str]:
        """By class, those without any too."""
        found = Counter[str]()
        for row in self.results.values():
            found.update(row.detections)
        return found

    def __str__(self) -> str:
        counts = self.counts
        states = ", ".join(f"{count} {state}" for state, count in self.states.items())
        return (
            f"recordings  {self.count}: {states}\n"
            f"{report(counts, +self.detections, expected=counts['images'] + counts['missing'])}"
            f"rate        {self.rate_hz:.1f} images per second in this run\n"
        )


def check_summary(folder: Path) -> None:
    """Raise OutputError if `folder` has a file of another program where the summary will be."""
    file = folder / SUMMARY_NAME
    if os.path.lexists(file) and not (file.is_file() and file.read_bytes().startswith(_BEGIN)):
        raise OutputError(f"{file} is not a summary of detect_bag: move it, or choose another --output.")


def write_summary(plan: Plan, batch: Batch, order: Sequence[str]) -> None:
    """Write the file, with rows in `order`, in place of that of an earlier run. Raises OSError."""
    rows = [batch.results[name] for name in order]
    content = {
        "weights": plan.settings.weights,
        "weights_sha256": plan.settings.weights_sha256,
        "settings_sha256": plan.settings_sha256,
        "recordings": len(rows),
        "states": batch.states,
        **batch.counts,
        "detections": batch.detections,
        "results": [row.model_dump() for row in rows],
    }
    text = json.dumps(content, indent=1, ensure_ascii=False).encode("utf-8", "backslashreplace") + b"\n"
    atomic_write(plan.output / SUMMARY_NAME, text)
