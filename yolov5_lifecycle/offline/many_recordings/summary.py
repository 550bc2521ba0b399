"""The summary of many recordings: a row for each, as JSON and as a Parquet table."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import get_args

from yolov5_lifecycle.atomic_file import OutputError, atomic_write, write_together
from yolov5_lifecycle.offline.many_recordings.plan import Plan
from yolov5_lifecycle.offline.many_recordings.results import COUNTED, RecordingResult, State
from yolov5_lifecycle.offline.many_recordings.tally import sums
from yolov5_lifecycle.process.missing_package import absence_of
from yolov5_lifecycle.unfinished import open_itself

JSON_NAME, PARQUET_NAME = "summary.json", "summary.parquet"
CLASS_COLUMN = "detections/"
"""Prefix of the columns of classes in the table."""
_BEGIN = b'{\n "weights": "'
_TYPES = dict.fromkeys(RecordingResult.model_fields, "string") | {
    **dict.fromkeys((*COUNTED, "detections"), "int64"),
    "seconds": "float64",
}
"""Of the columns of the table, in their order."""


def check_summary(folder: Path) -> None:
    """Raise OutputError if `folder` has a file of another program where the summary will be.

    The table is written after the JSON file: without that it belongs to another program.
    """
    if _is_summary(folder / JSON_NAME):
        return
    for file in (folder / JSON_NAME, folder / PARQUET_NAME):
        if os.path.lexists(file):
            raise OutputError(f"{file} is not a summary of detect_bag: move it, or choose another --output.")


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
        atomic_write(json_file, text, b"\n")
        table.unlink(missing_ok=True)  # it would be that of an earlier run
        return [f"{PARQUET_NAME} was not written, only {JSON_NAME}: {absence}"]
    write_together({json_file: text + b"\n", table: _parquet(results)})
    return []


def summary(plan: Plan, results: Sequence[RecordingResult]) -> Mapping[str, object]:
    """The content of the JSON file."""
    counts, detections = sums(results)
    return {
        "weights": plan.settings.weights,
        "weights_sha256": plan.settings.weights_sha256,
        "settings_sha256": plan.settings_sha256,
        "recordings": len(results),
        **{
            state.replace(" ", "_"): sum(result.state == state for result in results)
            for state in get_args(State)
        },
        **counts,
        "detections": dict(detections),
        "results": [result.model_dump() for result in results],
    }


def _parquet(results: Sequence[RecordingResult]) -> bytes:
    """A table with a column for each class; a recording that was set aside has no values in those."""
    import pyarrow
    from pyarrow import parquet

    classes = dict.fromkeys(f"{CLASS_COLUMN}{name}" for result in results for name in result.detections)
    schema = pyarrow.schema(list((_TYPES | dict.fromkeys(classes, "int64")).items()))
    sink = pyarrow.BufferOutputStream()
    parquet.write_table(pyarrow.Table.from_pylist(list(map(_table_row, results)), schema), sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _table_row(result: RecordingResult) -> dict[str, object]:
    total = None if result.state == "set aside" else sum(result.detections.values())
    by_class = {f"{CLASS_COLUMN}{name}": count for name, count in result.detections.items()}
    return {**result.model_dump(), **by_class, "detections": total}
