"""What a command that runs over many images reports on the terminal meanwhile."""

from __future__ import annotations

import time

from yolov5_lifecycle.offline.detecting import Account
from yolov5_lifecycle.process.standard_streams import complain, show_progress
from yolov5_lifecycle.streaming.frame_statistics import Outcome

_MAX_TOLD = 10
_PROGRESS_PERIOD_S = 0.1


class Terminal:
    """Reports of `command` on stderr: the first problems, and progress if no lines go to stdout."""

    def __init__(self, command: str, *, shows_progress: bool) -> None:
        self._command = command
        self._shows_progress = shows_progress
        self._lost = 0
        self._due_s = 0.0
        self._is_line_open = False

    def lost(self, label: str, outcome: Outcome, error: Exception) -> None:
        self._lost += 1
        if self._lost <= _MAX_TOLD:
            self.close()
            complain(self._command, f"{label}: {outcome.value}: {error}")
        if self._lost == _MAX_TOLD:
            complain(self._command, "further ones are only counted")

    def progress(self, account: Account) -> None:
        now_s = time.monotonic()
        if self._shows_progress and now_s >= self._due_s:
            self._due_s = now_s + _PROGRESS_PERIOD_S
            of_all = f" of {account.expected}" if account.expected else ""
            self._show(f"{account.balance.received}{of_all} images, {account.rate_hz:.1f} per second")

    def begin(self, task: str) -> None:
        """Show that `task` has begun, which has no images to count."""
        if self._shows_progress:
            self._show(task)

    def close(self) -> None:
        """End the progress line."""
        if self._is_line_open:
            show_progress("", done=True)
        self._is_line_open = False

    def _show(self, text: str) -> None:
        show_progress(f"{text:<60}")  # padded to overwrite a longer text
        self._is_line_open = True
