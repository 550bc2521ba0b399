"""How far a run over many recordings is, and its summary: a JSON file with a row for each."""

from __future__ import annotations

import json
import os
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

from yolov5_lifecycle.atomic_file import OutputError, atomic_write
from yolov5_lifecycle.offline.detecting import RunStatistics
from yolov5_lifecycle.offline.many_recordings.results import Plan, RecordingResult, State
from yolov5_lifecycle.offline.terminal import report

JSON_NAME = "summary.json"
_BEGIN = b'{\n "weights": "'
_COUNTED = tuple(RunStatistics(0).counts)
"""Columns of a row that are summed up for all recordings."""


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
    file = folder / JSON_NAME
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
    atomic_write(plan.output / JSON_NAME, text)
