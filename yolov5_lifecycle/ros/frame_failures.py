"""Frames that gave no detections, and what to do about them."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable

from rclpy.node import Node

from yolov5_lifecycle.frame_balance import Outcome
from yolov5_lifecycle.runtimes.runtime import DeviceLostError

_RECENT_S = 2.0


class FrameFailures:
    """Says failures in the log once in a while, and calls `on_too_many(reason)` after as many in a row as the
    parameter `max_consecutive_failures` of `node` says at that time.

    `on_device_lost(reason)` is called when no further frame can succeed. Both run in the executor.

    Keeps texts only: an exception would keep the model alive through its traceback.
    """

    def __init__(
        self, node: Node, *, on_too_many: Callable[[str], None], on_device_lost: Callable[[str], None]
    ) -> None:
        self._node = node
        self._on_too_many = on_too_many
        self._on_device_lost = on_device_lost
        self._consecutive = 0
        self._rejection = ""
        self._rejected_s = float("-inf")

    def succeeded(self) -> None:
        self._consecutive = 0

    def failed(self, outcome: Outcome, error: Exception) -> None:
        """Called in the worker's thread."""
        if outcome is Outcome.REJECTED:
            self._node.get_logger().warning(f"image rejected: {error}", throttle_duration_sec=5.0)
            self._rejection, self._rejected_s = str(error), time.monotonic()
            return
        self._consecutive += 1
        reason = f"{type(error).__name__}: {error}"
        # Runtimes and libraries raise RuntimeErrors; anything else is a mistake of ours.
        told = reason if isinstance(error, RuntimeError) else "".join(traceback.format_exception(error))
        self._node.get_logger().error(f"inference failed: {told}", throttle_duration_sec=5.0)
        if isinstance(error, DeviceLostError):
            self._tell(self._on_device_lost, reason)
        elif self._consecutive >= self._node.get_parameter("max_consecutive_failures").value:
            self._tell(self._on_too_many, f"{self._consecutive} failed frames in a row, the last: {reason}")
            self._consecutive = 0

    def _tell(self, what: Callable[[str], None], reason: str) -> None:
        if (executor := self._node.executor) is not None:
            executor.create_task(what, reason)

    def recent_rejection(self) -> str:
        """Why the last image was rejected, if that was just now."""
        return self._rejection if time.monotonic() - self._rejected_s < _RECENT_S else ""
