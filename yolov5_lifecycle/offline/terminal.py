"""What a command reports on the terminal while it processes many images, and at its end."""

from __future__ import annotations

import time
from collections import Counter

from yolov5_lifecycle.offline.detecting import RunStatistics
from yolov5_lifecycle.printable import MAX_TEXT, in_one_line
from yolov5_lifecycle.process.standard_streams import complain, show_progress
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_MAX_TOLD = 10
_PROGRESS_PERIOD_S = 0.1


class ProgressLine:
    """A line that is overwritten, if stderr is a terminal."""

    def __init__(self) -> None:
        self._due_s = 0.0
        self._is_open = False

    def show(self, text: str) -> None:
        """Show `text`, unless the previous one has only just been shown."""
        now_s = time.monotonic()
        if now_s >= self._due_s:
            self._due_s = now_s + _PROGRESS_PERIOD_S
            self.show_now(text)

    def show_now(self, text: str) -> None:
        show_progress(text)
        self._is_open = True

    def close(self) -> None:
        """End the line."""
        if self._is_open:
            show_progress("", done=True)
        self._is_open = False


class Terminal:
    """Reports of `command` on stderr: the first problems, and progress if no lines go to stdout."""

    def __init__(self, command: str, *, shows_progress: bool) -> None:
        self._command = command
        self._shows_progress = shows_progress
        self._lost = 0
        self._line = ProgressLine()

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        self._lost += 1
        if self._lost <= _MAX_TOLD:
            self.close()
            complain(self._command, f"{label}: {outcome.value}: {error}")
        if self._lost == _MAX_TOLD:
            complain(self._command, "further problems are only counted")

    def progress(self, statistics: RunStatistics) -> None:
        if self._shows_progress:
            of_all = f" of {statistics.expected}" if statistics.expected else ""
            self._line.show(
                f"{statistics.balance.received}{of_all} images, {statistics.rate_hz:.1f} per second"
            )

    def begin(self, task: str) -> None:
        """Show the name of a `task` that has no images to count."""
        if self._shows_progress:
            self._line.show_now(task)

    def close(self) -> None:
        """End the progress line."""
        self._line.close()


def missing_images(claimed: int, received: int) -> str:
    """What is wrong with a recording that has fewer images than it claims, and what to do."""
    return (
        f"the recording claims {claimed} images, but has {received}: it was damaged or changed. Compare it "
        "with the original, or repair it with `mcap recover` (.mcap) or `ros2 bag reindex`."
    )


def report(statistics: RunStatistics) -> str:
    """Summary of a run for the user, one fact per line."""
    balance, objects = statistics.balance, statistics.objects
    missing = f" of {statistics.expected} expected" if balance.received < statistics.expected else ""
    return (
        f"images    {balance.received}{missing}: {balance[Outcome.DETECTED]} detected, "
        f"{balance[Outcome.REJECTED]} rejected, {balance[Outcome.FAILED]} failed\n"
        f"{objects_line(objects)}"
        f"{order_line(statistics.stamps.late, statistics.stamps.jumps)}"
        f"rate        {statistics.rate_hz:.1f} images per second\n"
    )


def order_line(late: int, jumps: int) -> str:
    """The line of the summary about stamps that were not in order; "" if all were, or nothing was tracked."""
    if not late + jumps:
        return ""
    return f"stamps      late images not tracked: {late}, jumps back at which tracking began anew: {jumps}\n"


def objects_line(objects: Counter[str]) -> str:
    """The line of the summary that counts detections."""
    names = in_one_line(", ".join(f"{name} {count}" for name, count in objects.most_common()), MAX_TEXT)
    return f"detections  {objects.total()}{': ' if names else ''}{names}\n"
