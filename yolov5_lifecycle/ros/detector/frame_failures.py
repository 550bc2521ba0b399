"""Handling of rejected images and failed inference."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable

from rclpy.node import Node

from yolov5_lifecycle.runtimes.runtime import DeviceLostError
from yolov5_lifecycle.streaming.frame_statistics import Outcome

RECENT_S = 2.0
"""A rejection or failure is reported in diagnostics for this long."""


class FrameFailures:
    """Counts failed frames of each camera, and reports when detection should end.

    Calls `on_too_many(reason)` when the frames of a camera have failed `max_consecutive()` times in a row and
    no other camera's last frame succeeded, and `on_device_lost(reason)` when no further frame can succeed.
    Both run in the executor.
    """

    def __init__(
        self,
        node: Node,
        *,
        max_consecutive: Callable[[], int],
        on_too_many: Callable[[str], object],
        on_device_lost: Callable[[str], None],
    ) -> None:
        self._node = node
        self._max_consecutive = max_consecutive
        self._on_too_many = on_too_many
        self._on_device_lost = on_device_lost
        self._cameras: dict[CameraFailures, int] = {}
        """Failed frames in a row, of the cameras that had a frame since the last restart."""

    def restart(self) -> None:
        """Forget all failures, for example on activation."""
        self._cameras = {}

    def of_camera(self, name: str) -> CameraFailures:
        """Failures of the camera `name` in `cameras`; "" is the one without a name."""
        return CameraFailures(self._node, name, self)

    def succeeded(self, camera: CameraFailures) -> None:
        """Count a frame with detections; called in the worker thread, like `failed`."""
        self._cameras[camera] = 0

    def failed(self, camera: CameraFailures, error: Exception, reason: str) -> None:
        """Count a frame that failed with `error`."""
        count = self._cameras[camera] = self._cameras.get(camera, 0) + 1
        if isinstance(error, DeviceLostError):
            self._tell(self._on_device_lost, reason)
        elif count >= self._max_consecutive() and not self._is_any_served():
            self._tell(self._on_too_many, f"{count} failed frames in a row, the last: {reason}")
            self.restart()

    def _is_any_served(self) -> bool:
        return 0 in tuple(self._cameras.values())

    def _tell(self, what: Callable[[str], object], reason: str) -> None:
        if (executor := self._node.executor) is not None:
            executor.create_task(what, reason)


class CameraFailures:
    """Logs the problems with frames of one camera, throttled, and keeps the last one.

    `camera` is its name in `cameras`, "" for the one without a name. Keeps strings only: an exception would
    keep the model alive through its traceback.
    """

    def __init__(self, node: Node, camera: str, failures: FrameFailures) -> None:
        self._node = node
        self._whose = f" of camera {camera}" if camera else ""
        self._failures = failures
        self.last_problem = ""
        self._happened_s = float("-inf")

    def succeeded(self) -> None:
        """Handle a frame with detections; called in the worker thread, like `failed`."""
        self._failures.succeeded(self)

    def failed(self, outcome: Outcome, error: Exception) -> None:
        """Handle a frame without detections."""
        if outcome is Outcome.REJECTED:
            self._note(f"images are rejected: {error}")
            self._node.get_logger().warning(
                f"image{self._whose} rejected: {error}", throttle_duration_sec=5.0
            )
            return
        reason = f"{type(error).__name__}: {error}"
        self._note(f"inference fails: {reason}")
        # Runtimes and libraries raise RuntimeError; anything else is a bug here, so log the traceback.
        told = reason if isinstance(error, RuntimeError) else "".join(traceback.format_exception(error))
        self._node.get_logger().error(f"inference{self._whose} failed: {told}", throttle_duration_sec=5.0)
        self._failures.failed(self, error, reason)

    def recent(self) -> str:
        """The last problem, "" if it happened more than `RECENT_S` ago."""
        return self.last_problem if time.monotonic() - self._happened_s < RECENT_S else ""

    def _note(self, problem: str) -> None:
        self.last_problem, self._happened_s = problem, time.monotonic()
