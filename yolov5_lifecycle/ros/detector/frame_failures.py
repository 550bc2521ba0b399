"""Handling of rejected images and failed inference."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

from rclpy.node import Node

from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.streaming.frame_statistics import Outcome

RECENT_S = 2.0
"""A rejection or failure is reported in diagnostics for this long."""


@dataclass(eq=False)
class FrameFailures:
    """Logs the problems with frames, throttled, keeps the last one of each camera, and reports when detection
    should end.

    Calls `on_too_many(reason)` when the frames of a camera have failed `max_consecutive()` times in a row and
    no other camera's last frame succeeded, and `on_device_lost(reason)` when no further frame can succeed.
    Both run in the executor. A camera is its name in `cameras`, "" if it has none.
    """

    node: Node
    _: KW_ONLY
    max_consecutive: Callable[[], int]
    on_too_many: Callable[[str], object]
    on_device_lost: Callable[[str], None]

    def __post_init__(self) -> None:
        self._in_a_row: dict[str, int] = {}
        """Failed frames, of the cameras that had a frame since the last restart."""
        # Strings only: an exception would keep the model alive through its traceback.
        self._problems: dict[str, tuple[str, float]] = {}

    def restart(self) -> None:
        """Count anew, for example on activation."""
        self._in_a_row = {}

    def forget(self, camera: str) -> None:
        """Drop the last problem of a camera that has ended."""
        self._problems.pop(camera, None)

    def last_problem(self, camera: str) -> str:
        return self._problems.get(camera, ("", 0.0))[0]

    def recent(self, camera: str) -> str:
        """The last problem, "" if it happened more than `RECENT_S` ago."""
        problem, happened_s = self._problems.get(camera, ("", 0.0))
        return problem if time.monotonic() - happened_s < RECENT_S else ""

    def report(self, camera: str, outcome: Outcome, error: Exception | None) -> None:
        """Handle the end of a frame of `camera`, in the inference thread."""
        if error is None:
            self._in_a_row[camera] = 0
            return
        whose, log = f" of camera {camera}" if camera else "", self.node.get_logger()
        if outcome is Outcome.REJECTED:
            self._problems[camera] = f"images are rejected: {error}", time.monotonic()
            log.warning(f"image{whose} rejected: {error}", throttle_duration_sec=5.0)
            return
        reason = f"{type(error).__name__}: {error}"
        self._problems[camera] = f"inference fails: {reason}", time.monotonic()
        # Runtimes and libraries raise RuntimeError; anything else is a bug here, so log the traceback.
        told = reason if isinstance(error, RuntimeError) else "".join(traceback.format_exception(error))
        log.error(f"inference{whose} failed: {told}", throttle_duration_sec=5.0)
        self._count(camera, error, reason)

    def _count(self, camera: str, error: Exception, reason: str) -> None:
        count = self._in_a_row[camera] = self._in_a_row.get(camera, 0) + 1
        if isinstance(error, DeviceLostError):
            self._tell(self.on_device_lost, reason)
        elif count >= self.max_consecutive() and 0 not in tuple(self._in_a_row.values()):
            self._tell(self.on_too_many, f"{count} failed frames in a row, the last: {reason}")
            self.restart()

    def _tell(self, what: Callable[[str], object], reason: str) -> None:
        if (executor := self.node.executor) is not None:
            executor.create_task(what, reason)
