"""How far a run over many recordings is, and its summary: a row for each, as JSON and as a Parquet table."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from yolov5_lifecycle.atomic_file import OutputError, atomic_write, write_together
from yolov5_lifecycle.offline.many_recordings.results import COUNTED, Plan, RecordingResult, State
from yolov5_lifecycle.offline.terminal import ProgressLine, objects_line, order_line
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.process.standard_streams import complain

JSON_NAME, PARQUET_NAME = "summary.json", "summary.parquet"
CLASS_COLUMN = "detections/"
"""Prefix of the columns of classes in the table."""
_BEGIN = b'{\n "weights": "'
_TYPES = dict.fromkeys(RecordingResult.model_fields, "string") | {
    **dict.fromkeys((*COUNTED, "detections"), "int64"),
    "seconds": "float64",
}
"""Of the columns of the table, in their order."""


class BatchProgress:
    """The results of a run over `count` recordings."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.results: dict[str, RecordingResult] = {}
        self._in_progress: dict[str, int] = {}
        self._begun_s: float | None = None

    def begin(self) -> None:
        """The first model is loaded."""
        self._begun_s = self._begun_s or time.monotonic()

    @property
    def has_begun(self) -> bool:
        return self._begun_s is not None

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
        """Images per second since the first model was loaded, of all workers together."""
        return 0.0 if self._begun_s is None else self.images / max(time.monotonic() - self._begun_s, 1e-9)

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
        """The sum of each of COUNTED."""
        return {name: sum(getattr(row, name) for row in self.results.values()) for name in COUNTED}

    @property
    def detections(self) -> Counter[str]:
        """By class, those without any too."""
        found = Counter[str]()
        for row in self.results.values():
            found.update(row.detections)
        return found

    def __str__(self) -> str:
        """Summary for the user, one fact per line."""
        counts = self.counts
        states = ", ".join(f"{count} {state}" for state, count in self.states.items())
        missing = f", {counts['missing']} missing" if counts["missing"] else ""
        return (
            f"recordings  {self.count}: {states}\n"
            f"images      {counts['images']}: {counts['detected']} detected, {counts['rejected']} rejected, "
            f"{counts['failed']} failed{missing}\n"
            f"{objects_line(+self.detections)}"
            f"{order_line(counts['late'], counts['jumps'])}"
            f"rate        {self.rate_hz:.1f} images per second in this run\n"
        )


class BatchTerminal(ProgressLine):
    """Reports what went wrong, and progress over all."""

    def remark(self, text: str) -> None:
        """Tell what the user should know, such as a recording without a result."""
        self.close()
        complain("detect_bag", text)

    def progress(self, batch: BatchProgress) -> None:
        self.show(
            f"{len(batch.results)} of {batch.count} recordings, {batch.images} images, "
            f"{batch.rate_hz:.1f} per second"
        )


def check_summary(folder: Path) -> None:
    """Raise OutputError if `folder` has a file of another program where the summary will be.

    The table is written after the JSON file: without that it belongs to another program.
    """
    json_file, table = folder / JSON_NAME, folder / PARQUET_NAME
    if json_file.is_file():
        with json_file.open("rb") as opened:
            if opened.read(len(_BEGIN)) == _BEGIN:
                return
    for file in (json_file, table):
        if os.path.lexists(file):
            raise OutputError(f"{file} is not a summary of detect_bag: move it, or choose another --output.")


def write_summary(plan: Plan, batch: BatchProgress, order: Sequence[str]) -> list[str]:
    """Write both files, with rows in `order`, and return why one was left out. Raises OSError.

    They replace those of an earlier run when both are whole.
    """
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
    text = json.dumps(content, indent=1, ensure_ascii=False).encode("utf-8", "backslashreplace")
    json_file, table = plan.output / JSON_NAME, plan.output / PARQUET_NAME
    if absence := absence_of("pyarrow"):
        atomic_write(json_file, text, b"\n")
        table.unlink(missing_ok=True)  # it would be that of an earlier run
        return [f"{PARQUET_NAME} was not written, only {JSON_NAME}: {absence}"]
    write_together({json_file: text + b"\n", table: _parquet(rows)})
    return []


def _parquet(results: Sequence[RecordingResult]) -> bytes:
    """A table with a column for each class; a recording that failed has no values in those."""
    import pyarrow
    from pyarrow import parquet

    classes = dict.fromkeys(f"{CLASS_COLUMN}{name}" for result in results for name in result.detections)
    schema = pyarrow.schema(list((_TYPES | dict.fromkeys(classes, "int64")).items()))
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(pyarrow.Table.from_pylist(list(map(_table_row, results)), schema), sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _table_row(result: RecordingResult) -> dict[str, object]:
    total = None if result.state == "failed" else sum(result.detections.values())
    by_class = {f"{CLASS_COLUMN}{name}": count for name, count in result.detections.items()}
    return {**result.model_dump(), **by_class, "detections": total}
