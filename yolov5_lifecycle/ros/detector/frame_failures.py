"""Handling of rejected images and failed inference."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable

from rclpy.node import Node

from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.streaming.frame_statistics import Outcome

RECENT_S = 2.0
"""A rejection is reported in diagnostics for this long."""


class FrameFailures:
    """Logs failures, throttled, and counts consecutive ones.

    Calls `on_too_many(reason)` once the count reaches `max_consecutive()`, and `on_device_lost(reason)` when
    no further frame can succeed. Both run in the executor. Keeps strings only: an exception would keep the
    model alive through its traceback.
    """

    def __init__(
        self,
        node: Node,
        *,
        max_consecutive: Callable[[], int],
        on_too_many: Callable[[str], None],
        on_device_lost: Callable[[str], None],
    ) -> None:
        self._node = node
        self._max_consecutive = max_consecutive
        self._on_too_many = on_too_many
        self._on_device_lost = on_device_lost
        self._consecutive = 0
        self._rejection = ""
        self._rejected_s = float("-inf")

    def succeeded(self) -> None:
        self._consecutive = 0

    def failed(self, outcome: Outcome, error: Exception) -> None:
        """Handle a frame without detections; called in the worker thread."""
        if outcome is Outcome.REJECTED:
            self._node.get_logger().warning(f"image rejected: {error}", throttle_duration_sec=5.0)
            self._rejection, self._rejected_s = str(error), time.monotonic()
            return
        self._consecutive += 1
        reason = f"{type(error).__name__}: {error}"
        # Runtimes and libraries raise RuntimeError; anything else is a bug here, so log the traceback.
        told = reason if isinstance(error, RuntimeError) else "".join(traceback.format_exception(error))
        self._node.get_logger().error(f"inference failed: {told}", throttle_duration_sec=5.0)
        if isinstance(error, DeviceLostError):
            self._tell(self._on_device_lost, reason)
        elif self._consecutive >= self._max_consecutive():
            self._tell(self._on_too_many, f"{self._consecutive} failed frames in a row, the last: {reason}")
            self._consecutive = 0

    def _tell(self, what: Callable[[str], None], reason: str) -> None:
        if (executor := self._node.executor) is not None:
            executor.create_task(what, reason)

    def recent_rejection(self) -> str:
        """Why the last image was rejected, "" if that was more than `RECENT_S` ago."""
        return self._rejection if time.monotonic() - self._rejected_s < RECENT_S else ""
