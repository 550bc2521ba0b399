"""What a command reports on the terminal while it processes many images, and at its end."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping

from yolov5_lifecycle.offline.detecting import DetectingError, RunStatistics
from yolov5_lifecycle.printable import MAX_TEXT, in_one_line
from yolov5_lifecycle.process.missing_package import import_problem
from yolov5_lifecycle.process.standard_streams import complain, show_progress
from yolov5_lifecycle.runtimes.runtime import InferenceError
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_MAX_TOLD = 10
_PROGRESS_PERIOD_S = 0.1


def exit_code(command: str, run: Callable[[], int]) -> int:
    """What `run` returns; if it cannot do its work, reports why and returns 1, or 130 if interrupted."""
    try:
        return run()
    except BrokenPipeError:
        raise  # not reported: the reader closed the output pipe, as with `| head`
    except SettingsError as error:
        listing = "".join(f"\n  {problem}" for problem in error.problems)
        complain(command, f"{len(error.problems)} problem(s) in the settings:{listing}")
    except ImportError as error:
        complain(command, import_problem(error))
    except (ValueError, OSError, DetectingError, InferenceError) as error:
        complain(command, str(error))
    except KeyboardInterrupt:
        complain(command, "interrupted; unfinished output was removed")
        return 130
    return 1


class Terminal:
    """Reports of `command` on stderr: problems, and a line of progress if no lines go to stdout."""

    def __init__(self, command: str, *, shows_progress: bool) -> None:
        self._command = command
        self._shows_progress = shows_progress
        self._lost = 0
        self._due_s = 0.0
        self._is_open = False

    def tell(self, problem: str) -> None:
        self.close()
        complain(self._command, problem)

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        """Tell of the first images that could not be processed."""
        self._lost += 1
        if self._lost <= _MAX_TOLD:
            self.tell(f"{label}: {outcome.value}: {error}")
        if self._lost == _MAX_TOLD:
            self.tell("further problems are only counted")

    def progress(self, statistics: RunStatistics) -> None:
        of_all = f" of {statistics.expected}" if statistics.expected else ""
        self.show(f"{statistics.outcomes.total()}{of_all} images, {statistics.rate_hz:.1f} per second")

    def show(self, text: str) -> None:
        """Show `text` as progress, unless the previous one has only just been shown."""
        if time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + _PROGRESS_PERIOD_S
            self.begin(text)

    def begin(self, task: str) -> None:
        """Show the name of a `task` that has no images to count."""
        if self._shows_progress:
            show_progress(task)
            self._is_open = True

    def close(self) -> None:
        """End the line of progress."""
        if self._is_open:
            show_progress("", done=True)
        self._is_open = False


def missing_images(claimed: int, received: int) -> str:
    """What is wrong with a recording that has fewer images than it claims, and what to do."""
    return (
        f"the recording claims {claimed} images, but has {received}: it was damaged or changed. Compare it "
        "with the original, or repair it with `mcap recover` (.mcap) or `ros2 bag reindex`."
    )


def report(counts: Mapping[str, int], objects: Counter[str], *, expected: int) -> str:
    """Summary for the user, one fact per line: `counts` as in RunStatistics, and detections by class."""
    missing = f" of {expected} expected" if counts["images"] < expected else ""
    names = in_one_line(", ".join(f"{name} {count}" for name, count in objects.most_common()), MAX_TEXT)
    lines = (
        f"images    {counts['images']}{missing}: {counts['detected']} detected, "
        f"{counts['rejected']} rejected, {counts['failed']} failed\n"
        f"detections  {objects.total()}{': ' if names else ''}{names}\n"
    )
    if counts["late"] or counts["jumps"]:
        lines += (
            f"stamps      late images not tracked: {counts['late']}, "
            f"jumps back at which tracking began again: {counts['jumps']}\n"
        )
    return lines
