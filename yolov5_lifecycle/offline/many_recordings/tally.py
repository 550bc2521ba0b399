"""How far a run over many recordings is, and what the user sees of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from typing import get_args

from yolov5_lifecycle.offline.many_recordings.results import COUNTED, RecordingResult, State
from yolov5_lifecycle.offline.terminal import ProgressLine, objects_line, order_line
from yolov5_lifecycle.process.standard_streams import complain


class Tally:
    """The results of a run over `count` recordings."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.results: dict[str, RecordingResult] = {}
        self._in_progress: dict[str, int] = {}
        self._images = 0
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
        self._images += result.images if result.state == "done" else 0

    @property
    def images(self) -> int:
        """Images of this run, of unfinished recordings too."""
        return self._images + sum(self._in_progress.values())

    @property
    def rate_hz(self) -> float:
        """Images per second since the first model was loaded, of all workers together."""
        return 0.0 if self._begun_s is None else self.images / max(time.monotonic() - self._begun_s, 1e-9)

    @property
    def is_complete(self) -> bool:
        """Whether every recording has a result with all its images."""
        return not any(result.state == "set aside" or result.missing for result in self.results.values())

    def in_state(self, state: str) -> int:
        """How many recordings are in `state`."""
        return sum(result.state == state for result in self.results.values())


class RecordingsTerminal:
    """Reports what went wrong, and progress over all."""

    def __init__(self) -> None:
        self._line = ProgressLine()

    def remark(self, text: str) -> None:
        """Tell what the user should know, such as a recording without a result."""
        self.close()
        complain("detect_bag", text)

    def progress(self, tally: Tally) -> None:
        self._line.show(
            f"{len(tally.results)} of {tally.count} recordings, {tally.images} images, "
            f"{tally.rate_hz:.1f} per second"
        )

    def close(self) -> None:
        """End the progress line."""
        self._line.close()


def sums(results: Iterable[RecordingResult]) -> tuple[dict[str, int], Counter[str]]:
    """The sums of all rows: of each of COUNTED, and of the detections by class, those without any too."""
    counts, detections = dict.fromkeys(COUNTED, 0), Counter[str]()
    for result in results:
        detections.update(result.detections)
        for name in COUNTED:
            counts[name] += getattr(result, name)
    return counts, detections


def recordings_report(tally: Tally) -> str:
    """Summary of many recordings for the user, one fact per line."""
    counts, detections = sums(tally.results.values())
    states = ", ".join(f"{tally.in_state(state)} {state}" for state in get_args(State))
    missing = f", {counts['missing']} missing" if counts["missing"] else ""
    return (
        f"recordings  {tally.count}: {states}\n"
        f"images      {counts['images']}: {counts['detected']} detected, {counts['rejected']} rejected, "
        f"{counts['failed']} failed{missing}\n"
        f"{objects_line(+detections)}"
        f"{order_line(counts['late'], counts['jumps'])}"
        f"rate        {tally.rate_hz:.1f} images per second in this run\n"
    )
