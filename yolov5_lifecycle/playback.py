"""Plays pictures at an even rate, in a thread of its own."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable

from yolov5_lifecycle.images import ImageError
from yolov5_lifecycle.picture_source import PictureSource, SourceError, SourceFrame

_POLL_S = 0.02


class Playback:
    """Opens a source and shows its frames until they end, fail or `stop` is called.

    All of it happens in a thread of its own: a device may take any time to open and to give a frame, and
    holds up nobody else. `show(frame)` is called there, from when `is_awaited()`.

    `rate_hz` is the frames a second, 0 the source's own. A device has its own pace: what it gives before it
    is due is dropped.
    """

    def __init__(
        self,
        open_source: Callable[[], PictureSource],
        show: Callable[[SourceFrame], None],
        *,
        rate_hz: float,
        is_awaited: Callable[[], bool] = lambda: True,
    ) -> None:
        self.failure = ""
        self._open_source = open_source
        self._show = show
        self._rate_hz = rate_hz
        self._is_awaited = is_awaited
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="playback", daemon=True)
        self._thread.start()

    @property
    def is_finished(self) -> bool:
        """Whether no frame will be shown any more; `failure` then says why, "" when the source just ended."""
        return not self._thread.is_alive()

    def stop(self, timeout_s: float) -> bool:
        """Show nothing new; False when the thread still hangs in its source, and is left there."""
        self._stop.set()
        self._thread.join(timeout_s)
        return self.is_finished

    def _run(self) -> None:
        try:
            self._play(self._open_source())
        except (SourceError, ImageError) as error:
            self.failure = str(error)
        except Exception:  # noqa: BLE001 - nobody else would tell why the thread ended
            self.failure = traceback.format_exc()

    def _play(self, source: PictureSource) -> None:
        while not self._is_awaited():
            if self._stop.wait(_POLL_S):
                return
        rate_hz = self._rate_hz or source.rate_hz
        period_s = 1 / rate_hz if rate_hz else 0.0
        due_s = time.monotonic()
        for frame in source.frames:
            early_s = due_s - time.monotonic()
            if source.rate_hz is None and early_s > 0 and not self._stop.is_set():
                continue
            if self._stop.wait(early_s):
                return
            self._show(frame)
            due_s = max(due_s + period_s, time.monotonic())  # what is late is not made up for
