"""The summary of many recordings: a row for each, as JSON and as a Parquet table."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from yolov5_lifecycle.atomic_file import OutputError, write_together, write_whole
from yolov5_lifecycle.offline.many_recordings.plan import Plan
from yolov5_lifecycle.offline.many_recordings.recording_result import COUNTED, RecordingResult
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.unfinished import open_itself

JSON_NAME, PARQUET_NAME = "summary.json", "summary.parquet"
CLASS_COLUMN = "detections/"
"""Prefix of the columns of classes in the table."""
_BEGIN = b'{\n "weights": "'
_COLUMNS = {
    "recording": "string",
    "path": "string",
    "state": "string",
    "reason": "string",
    **dict.fromkeys(COUNTED, "int64"),
    "first_problem": "string",
    "seconds": "float64",
    "runtime": "string",
    "detections": "int64",
}


def check_summary(folder: Path) -> None:
    """Raise OutputError if `folder` has a file of another program where the summary will be.

    The table is written after the JSON file: without that it belongs to another program.
    """
    json_file, table = folder / JSON_NAME, folder / PARQUET_NAME
    if not _is_summary(json_file):
        foreign = next((file for file in (json_file, table) if os.path.lexists(file)), None)
        if foreign is not None:
            raise OutputError(
                f"{foreign} is not a summary of detect_bag: move it, or choose another --output."
            )


def _is_summary(path: Path) -> bool:
    """Whether the file at `path` begins like the JSON of `summary`."""
    try:
        with open(path, "rb", opener=open_itself) as file:
            return file.read(len(_BEGIN)) == _BEGIN
    except OSError:
        return False


def write_summary(plan: Plan, results: Sequence[RecordingResult]) -> list[str]:
    """Write both files to the folder of results and return why one was left out. Raises OSError.

    They replace those of an earlier run when both are whole.
    """
    text = json.dumps(summary(plan, results), indent=1, ensure_ascii=False).encode(
        "utf-8", "backslashreplace"
    )
    json_file, table = plan.output / JSON_NAME, plan.output / PARQUET_NAME
    if absence := absence_of("pyarrow"):
        write_whole(json_file, text, b"\n")
        table.unlink(missing_ok=True)  # it would be that of an earlier run
        return [f"{PARQUET_NAME} was not written, only {JSON_NAME}: {absence}"]
    write_together({json_file: text + b"\n", table: _parquet(results)})
    return []


def summary(plan: Plan, results: Sequence[RecordingResult]) -> Mapping[str, object]:
    """The content of the JSON file."""
    detections: Counter[str] = Counter()
    for result in results:
        detections.update(result.detections)
    return {
        "weights": plan.weights,
        "weights_sha256": plan.weights_sha256,
        "settings_sha256": plan.settings_sha256,
        "recordings": len(results),
        **{
            state.replace(" ", "_"): sum(result.state == state for result in results)
            for state in ("done", "skipped", "set aside")
        },
        **{name: sum(getattr(result, name) for result in results) for name in COUNTED},
        "detections": dict(detections),
        "results": [result.model_dump() for result in results],
    }


def _parquet(results: Sequence[RecordingResult]) -> bytes:
    """A table with a column for each class; a recording that was set aside has no values in those."""
    import pyarrow
    from pyarrow import parquet

    classes = dict.fromkeys(name for result in results for name in result.detections)
    columns: dict[str, Any] = {
        name: pyarrow.array([_value(result, name) for result in results], type_name)
        for name, type_name in _COLUMNS.items()
    }
    for name in classes:
        column = [result.detections.get(name) for result in results]
        columns[f"{CLASS_COLUMN}{name}"] = pyarrow.array(column, "int64")
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(pyarrow.table(columns), sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _value(result: RecordingResult, column: str) -> object:
    if column != "detections":
        return getattr(result, column)
    return None if result.state == "set aside" else sum(result.detections.values())
