"""The node's status on /diagnostics, in every lifecycle state."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Header

from yolov5_lifecycle.printable import in_lines
from yolov5_lifecycle.ros.detector.status import Status, Summary

_MAX_VALUE = 5_000
"""Max characters of one value; a path has up to 4096."""
_REPEAT_S = 60.0
"""A recurring reason is logged at most once in this time."""


class Diagnostics:
    """Publishes `status()` every `period_s`; logs namesakes, and why an active node has no output.

    `clock` returns monotonic seconds.
    """

    def __init__(
        self,
        node: Node,
        status: Callable[[], Status],
        *,
        period_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._node = node
        self._status = status
        self._clock = clock
        self._reasons: dict[str, ReasonLog] = {}
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Steady time: simulated time may be paused (use_sim_time without /clock).
        self._timer = node.create_timer(period_s, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Publish the current status now and log its reasons if they are new."""
        stamp = self._node.get_clock().now().to_msg()  # nothing in the status is older
        status = self._status()
        of_node, of_cameras = status.of_node, status.of_cameras
        name = self._node.get_fully_qualified_name()
        self._publisher.publish(
            DiagnosticArray(
                header=Header(stamp=stamp),
                status=[diagnostic_status(summary, name) for summary in (of_node, *of_cameras)],
            )
        )
        detecting = of_cameras or [of_node] if status.state == "active" else []
        self._log_reasons([of_node] if status.namesakes else detecting)

    def _log_reasons(self, summaries: Sequence[Summary]) -> None:
        logs = {summary.name: self._reasons.get(summary.name) or ReasonLog() for summary in summaries}
        self._reasons = logs
        for summary in summaries:
            reason = summary.hint or summary.remark
            if not logs[summary.name].is_new(reason, self._clock()):
                continue
            text = f"{summary.name}: {reason}" if summary.is_of_camera else reason
            if summary.hint:
                self._node.get_logger().warning(text)
            else:
                self._node.get_logger().info(text)


class ReasonLog:
    """Decides which reasons to log: each when it appears, and when it recurs after `_REPEAT_S`.

    A text in which only numbers changed is the same reason.
    """

    def __init__(self) -> None:
        self._reason = ""
        self._said_s: dict[str, float] = {}

    def is_new(self, text: str, now_s: float) -> bool:
        """Whether to log `text` at `now_s` (monotonic seconds)."""
        reason, before = re.sub(r"[\d.]+", "", text), self._reason
        self._reason = reason
        self._said_s = {said: when_s for said, when_s in self._said_s.items() if now_s - when_s < _REPEAT_S}
        if reason in ("", before) or reason in self._said_s:
            return False
        self._said_s[reason] = now_s
        return True


def diagnostic_status(summary: Summary, node_name: str) -> DiagnosticStatus:
    """Convert `summary` to a DiagnosticStatus: ERROR with a problem, WARN with a hint, else OK."""
    level = (
        DiagnosticStatus.ERROR
        if summary.problem
        else DiagnosticStatus.WARN
        if summary.hint
        else DiagnosticStatus.OK
    )
    return DiagnosticStatus(
        level=level,
        name=f"{node_name}: {summary.name}",
        message=in_lines(summary.message, _MAX_VALUE),
        hardware_id=node_name,
        values=[
            KeyValue(key=key, value=in_lines(value, _MAX_VALUE)) for key, value in summary.values.items()
        ],
    )
