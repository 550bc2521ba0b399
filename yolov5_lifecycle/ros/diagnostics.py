"""The node's state on /diagnostics, once a second in every state."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Header

from yolov5_lifecycle.ros.status import Status

_REPEAT_S = 60.0
"""A reason that comes and goes is said once in so long."""


class Diagnostics:
    """Publishes what `status()` tells, and says in the log why nothing comes out of an active node.

    `clock`: seconds that only grow.
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
        # Steady time: a simulated clock may stand still (use_sim_time without /clock).
        self._timer = node.create_timer(1.0, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Look at the node and tell now."""
        status = self._status()
        self._publisher.publish(
            DiagnosticArray(
                header=Header(stamp=self._node.get_clock().now().to_msg()),
                status=[diagnostic_status(status, self._node.get_fully_qualified_name())],
            )
        )
        self._say(status)

    def _say(self, status: Status) -> None:
        """Log a reason when it appears, not each time its numbers change, nor each time it comes and goes."""
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
    """ERROR with a problem, WARN with a hint, else OK."""
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
        message=status.message,
        hardware_id=node_name,
        values=[KeyValue(key=key, value=value) for key, value in status.values().items()],
    )
