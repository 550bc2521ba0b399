"""What an image source delivers: frames at a rate, or an error; their playback in a thread of its own."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.sources.scene import Shape
from yolov5_lifecycle.sources.scene_depth import DepthFrame

_POLL_S = 0.02


class SourceError(ValueError):
    """A source that is missing, unreadable or lost; the message says which and what to do."""


@dataclass(frozen=True)
class SourceFrame:
    """One image and, for the synthetic scene only, its shapes and, on request, its depth."""

    image: ColourImage
    shapes: Sequence[Shape] = ()
    depth: DepthFrame | None = None


@dataclass(frozen=True)
class ImageSource:
    """Frames and their nominal rate.

    `rate_hz` is None for a device, which delivers frames at its own pace.
    """

    frames: Iterator[SourceFrame]
    rate_hz: float | None
    claimed_frames: int = 0
    """What a video says of itself; 0 if unknown."""


class Playback:
    """Opens a source and passes its frames to `show` until they end, fail or `stop` is called.

    It runs in its own thread, so a device that is slow to open or to deliver frames blocks no other code.
    `show(frame)` is called in that thread, as soon as `is_awaited()` is true.

    `rate_hz` is in frames per second, 0 for the source's own rate. A device sets its own pace: frames that
    arrive before they are due are dropped.
    """

    def __init__(
        self,
        open_source: Callable[[], ImageSource],
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
        """Whether playback has ended; `failure` is then the reason, "" at the regular end of the source."""
        return not self._thread.is_alive()

    def stop(self, timeout_s: float) -> bool:
        """Stop playback; False when the thread still hangs in its source and is abandoned."""
        self._stop.set()
        self._thread.join(timeout_s)
        return self.is_finished

    def _run(self) -> None:
        try:
            self._play(self._open_source())
        except (SourceError, ImageError) as error:
            self.failure = str(error)
        except Exception:  # noqa: BLE001 - nothing else would report why the thread ended
            self.failure = traceback.format_exc()

    def _play(self, source: ImageSource) -> None:
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
            due_s = max(due_s + period_s, time.monotonic())  # late frames are not caught up
