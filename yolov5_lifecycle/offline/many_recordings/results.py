"""The plan for many recordings, the result of each, the record that says it is finished, and the summary."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, NonNegativeInt, ValidationError

from yolov5_lifecycle.atomic_file import OutputError, atomic_write
from yolov5_lifecycle.checkpoints.locate import weights_digest
from yolov5_lifecycle.detection.prepared_model import weights_path
from yolov5_lifecycle.offline.detecting import RunStatistics
from yolov5_lifecycle.offline.export.exporting import Export
from yolov5_lifecycle.offline.recordings import METADATA, SourceRecording, is_storage
from yolov5_lifecycle.offline.terminal import report
from yolov5_lifecycle.quantization.calibration_file import calibration_digest
from yolov5_lifecycle.settings.settings import Settings

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
        changes = {"runtime": runtime, "precision": precision}
        return replace(self, settings=self.settings.model_copy(update=changes))


def plan_of(settings: Settings, output: Path, export: Export) -> Plan:
    """The plan for the model that `settings` select, as its file is now; raises WeightsError and OSError."""
    weights = Path(os.path.abspath(weights_path(settings)))  # noqa: PTH100
    digest = weights_digest(weights, sha256=settings.weights_sha256)
    calibration = calibration_digest(weights) if settings.precision == "int8" else None
    values = settings.model_dump(mode="json", exclude=_PLACE_OF_WEIGHTS)
    return Plan(
        output=output,
        export=export,
        settings=settings.model_copy(update={"weights": str(weights), "weights_sha256": digest}),
        settings_sha256=_sha256(
            json.dumps([values, asdict(export), calibration], sort_keys=True, default=str)
        ),
    )


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


class RecordingResult(BaseModel):
    """A row of the summary; in the folder of a result, the record that it is finished."""

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
    made_from: str = ""
    """Digest of weights, settings and recording, see `origin`."""


def failed(source: SourceRecording, reason: str, **facts: Any) -> RecordingResult:
    """The row of a recording without a result, for this `reason`."""
    return RecordingResult(
        recording=source.name, path=str(source.path), state="failed", reason=reason, **facts
    )


def finished_before(source: SourceRecording, plan: Plan) -> RecordingResult | None:
    """The row of a recording whose result was made from the same; None if there is none."""
    try:
        row = RecordingResult.model_validate_json((plan.output / source.name / RECORD_NAME).read_bytes())
        made_from = origin(source.path, plan)
    except (OSError, ValidationError):
        return None
    if row.made_from != made_from:
        return None
    return row.model_copy(update={"state": "skipped", "recording": source.name, "path": str(source.path)})


def origin(recording: Path, plan: Plan) -> str:
    """Digest of weights, settings, and name, size and time of the last change of each file of a recording.

    Raises OSError.
    """
    files = [recording]
    if recording.is_dir():
        files = sorted(path for path in recording.iterdir() if is_storage(path) or path.name == METADATA)
    stats = [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    return _sha256(repr([plan.settings.weights_sha256, plan.settings_sha256, stats]))


@dataclass
class Batch:
    """The results of a run over `count` recordings; `str` of it is a summary for the user."""

    count: int
    results: dict[str, RecordingResult] = field(default_factory=dict)
    in_progress: dict[str, int] = field(default_factory=dict)
    """How many images of a recording are done."""
    done_images: int = 0
    """Images of the recordings that this run has finished."""
    begun_s: float = field(default_factory=time.monotonic)
    """When the first model was loaded."""

    def add(self, result: RecordingResult) -> None:
        self.in_progress.pop(result.recording, None)
        self.results[result.recording] = result
        if result.state == "done":
            self.done_images += result.images

    @property
    def images(self) -> int:
        """Images of this run, of unfinished recordings too."""
        return self.done_images + sum(self.in_progress.values())

    @property
    def rate(self) -> str:
        """Images per second of all workers together."""
        return f"{self.images / max(time.monotonic() - self.begun_s, 1e-9):.1f}"

    @property
    def progress(self) -> str:
        """What is done, in one line."""
        done = f"{len(self.results)} of {self.count} recordings, {self.images} images"
        return f"{done}, {self.rate} per second"

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
            f"rate        {self.rate} images per second in this run\n"
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
