"""The node's status on /diagnostics, at 1 Hz in every lifecycle state."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Header

from yolov5_lifecycle.printable import in_lines
from yolov5_lifecycle.ros.detector.status import Status

_MAX_VALUE = 5_000
"""Max characters of one value; a path has up to 4096."""
_REPEAT_S = 60.0
"""A recurring reason is logged at most once in this time."""


class Diagnostics:
    """Publishes `status()` and logs why an active node has no output.

    `clock` returns monotonic seconds.
    """

    def __init__(
        self, node: Node, status: Callable[[], Status], *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._node = node
        self._status = status
        self._clock = clock
        self._reason = ""
        self._said_s: dict[str, float] = {}
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
        # Steady time: simulated time may be paused (use_sim_time without /clock).
        self._timer = node.create_timer(1.0, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Publish the current status now and log its reason if it is new."""
        status = self._status()
        self._publisher.publish(
            DiagnosticArray(
                header=Header(stamp=self._node.get_clock().now().to_msg()),
                status=[diagnostic_status(status, self._node.get_fully_qualified_name())],
            )
        )
        self._say(status)

    def _say(self, status: Status) -> None:
        """Log a reason once when it appears; ignore changed numbers and, for `_REPEAT_S`, recurrences."""
        if status.state != "active":
            self._reason, self._said_s = "", {}
            return
        told = status.hint or status.remark
        reason, before = re.sub(r"[\d.]+", "", told), self._reason
        self._reason, now_s = reason, self._clock()
        self._said_s = {said: when_s for said, when_s in self._said_s.items() if now_s - when_s < _REPEAT_S}
        if reason in ("", before) or reason in self._said_s:
            return
        self._said_s[reason] = now_s
        if status.hint:
            self._node.get_logger().warning(told)
        else:
            self._node.get_logger().info(told)


def diagnostic_status(status: Status, node_name: str) -> DiagnosticStatus:
    """Convert `status` to a DiagnosticStatus: ERROR with a problem, WARN with a hint, else OK."""
    level = (
        DiagnosticStatus.ERROR
        if status.problem
        else DiagnosticStatus.WARN
        if status.hint
        else DiagnosticStatus.OK
    )
    return DiagnosticStatus(
        level=level,
        name=f"{node_name}: detection",
        message=in_lines(status.message, _MAX_VALUE),
        hardware_id=node_name,
        values=[
            KeyValue(key=key, value=in_lines(value, _MAX_VALUE)) for key, value in status.values().items()
        ],
    )
