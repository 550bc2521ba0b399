"""The node's state on /diagnostics, once a second in every state."""

from __future__ import annotations

import re
from collections.abc import Callable

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Header

from yolov5_lifecycle.ros.status import Status


class Diagnostics:
    """Publishes what `status()` tells, and says in the log why nothing comes out of an active node."""

    def __init__(self, node: Node, status: Callable[[], Status]) -> None:
        self._node = node
        self._status = status
        self._said = ""
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
        """Log a reason when it appears, not each time its numbers change."""
        remark = status.remark if status.state == "active" else ""
        reason = re.sub(r"\d+", "", status.hint or remark)
        if reason != self._said and status.hint:
            self._node.get_logger().warning(f"no detections: {status.hint}")
        elif reason != self._said and remark:
            self._node.get_logger().info(f"no detections: {remark}")
        self._said = reason


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
