"""What runs of `detect_bag` show on stderr."""

from __future__ import annotations

import time
from collections import Counter
from typing import get_args

from yolov5_lifecycle.offline.batch import Tally
from yolov5_lifecycle.offline.detecting import Account
from yolov5_lifecycle.offline.recording_result import RecordingResult, State
from yolov5_lifecycle.process.standard_streams import complain, show_progress
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_COMMAND = "detect_bag"
_MAX_TOLD = 10
_PROGRESS_PERIOD_S = 0.1
_COUNTED = ("images", "detected", "rejected", "failed")


class ProgressLine:
    """A line that is overwritten, if stderr is a terminal."""

    def __init__(self) -> None:
        self._due_s = 0.0
        self._is_open = False

    def show(self, text: str) -> None:
        """Show `text` if the last one has been there for some time."""
        now_s = time.monotonic()
        if now_s >= self._due_s:
            self._due_s = now_s + _PROGRESS_PERIOD_S
            show_progress(f"{text:<60}")  # padded to overwrite a longer text
            self._is_open = True

    def close(self) -> None:
        """End the line."""
        if self._is_open:
            show_progress("", done=True)
        self._is_open = False


class Terminal:
    """Reports one run: the first problems, and progress if no lines go to stdout."""

    def __init__(self, *, shows_progress: bool) -> None:
        self._shows_progress = shows_progress
        self._lost = 0
        self._line = ProgressLine()

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        self._lost += 1
        if self._lost <= _MAX_TOLD:
            self.close()
            complain(_COMMAND, f"{label}: {outcome.value}: {error}")
        if self._lost == _MAX_TOLD:
            complain(_COMMAND, "further ones are only counted")

    def progress(self, account: Account) -> None:
        if self._shows_progress:
            of_all = f" of {account.expected}" if account.expected else ""
            self._line.show(f"{account.balance.received}{of_all} images, {account.rate_hz:.1f} per second")

    def close(self) -> None:
        """End the progress line."""
        self._line.close()


class BatchTerminal:
    """Reports a batch: each recording that was set aside, and progress over all."""

    def __init__(self) -> None:
        self._line = ProgressLine()

    def set_aside(self, result: RecordingResult) -> None:
        self.remark(f"{result.recording}: set aside: {result.reason}")

    def remark(self, text: str) -> None:
        self.close()
        complain(_COMMAND, text)

    def progress(self, tally: Tally) -> None:
        self._line.show(
            f"{len(tally.results)} of {tally.count} recordings, {tally.images} images, "
            f"{tally.rate_hz:.1f} per second"
        )

    def close(self) -> None:
        """End the progress line."""
        self._line.close()


def report(account: Account) -> str:
    """Summary of a run for the user, one fact per line."""
    balance, objects = account.balance, account.objects
    missing = f" of {account.expected} announced" if balance.received < account.expected else ""
    return (
        f"images    {balance.received}{missing}: {balance[Outcome.DETECTED]} detected, "
        f"{balance[Outcome.REJECTED]} rejected, {balance[Outcome.FAILED]} failed\n"
        f"{_objects_line(objects)}"
        f"rate        {account.rate_hz:.1f} images per second\n"
    )


def batch_report(tally: Tally) -> str:
    """Summary of a batch for the user, one fact per line."""
    results = tally.results.values()
    objects: Counter[str] = Counter()
    for result in results:
        objects.update(+Counter(result.detections))
    images = {name: sum(getattr(result, name) for result in results) for name in _COUNTED}
    states = ", ".join(f"{tally.in_state(state)} {state}" for state in get_args(State))
    return (
        f"recordings  {tally.count}: {states}\n"
        f"images      {images['images']}: {images['detected']} detected, {images['rejected']} rejected, "
        f"{images['failed']} failed\n"
        f"{_objects_line(objects)}"
        f"rate        {tally.rate_hz:.1f} images per second in this run\n"
    )


def _objects_line(objects: Counter[str]) -> str:
    names = ", ".join(f"{name} {count}" for name, count in objects.most_common())
    return f"detections  {objects.total()}{': ' if names else ''}{names}\n"
