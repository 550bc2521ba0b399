"""The node's heartbeats for a lifecycle manager, which Nav2's takes for a bond.

The node sends `bond/msg/Status` on the topic `bond` and receives nothing there: the manager acts when the
heartbeats stop; this node, like Nav2's nodes, stays active when the manager's stop.
"""

from __future__ import annotations

import uuid
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from yolov5_lifecycle.process.missing_package import apt_package_of

TOPIC = "bond"
_HEARTBEAT_S = 0.1  # as Nav2's nodes and lifecycle manager use
_SHORTEST_HEARTBEAT_S = 0.01
_HEARTBEATS_IN_TIMEOUT = 4
_DELIVERY_S = 0.1  # bondcpp waits this long, too, for the other side to receive the end of the bond


class Bond:
    """This side of one bond: publishes heartbeats of `node` on the topic `bond`, several per `timeout_s`.

    It lasts from construction to `close`. Its id is the node's name, its instance id is unique.
    """

    def __init__(self, node: Node, timeout_s: float) -> None:
        self._status_type = status_type(timeout_s)
        self._node = node
        self._timeout_s = timeout_s
        self._period_s = max(_SHORTEST_HEARTBEAT_S, min(_HEARTBEAT_S, timeout_s / _HEARTBEATS_IN_TIMEOUT))
        self._instance_id = str(uuid.uuid4())
        self._publisher = node.create_publisher(self._status_type, TOPIC, 5)
        # Steady time: simulated time may be paused.
        self._timer = node.create_timer(
            self._period_s, self._publish, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def close(self) -> None:
        """Notify the manager that the bond ends and stop the heartbeats; takes at most 0.1 s."""
        self._publish(is_active=False)
        self._publisher.wait_for_all_acked(Duration(seconds=_DELIVERY_S))
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)

    def _publish(self, *, is_active: bool = True) -> None:
        message = self._status_type(
            id=self._node.get_name(),
            instance_id=self._instance_id,
            active=is_active,
            heartbeat_timeout=self._timeout_s,
            heartbeat_period=self._period_s,
        )
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


def status_type(timeout_s: float) -> Any:
    """Import bond/msg/Status, which only a bond needs; raise ValueError with the remedy."""
    try:
        from bond.msg import Status
    except ImportError as error:
        raise ValueError(
            f"bond_timeout {timeout_s:g} needs the ROS package 'bond', which is not installed ({error}). "
            f"Restart the node after `sudo apt install {apt_package_of('bond')}`, or with bond_timeout 0.0."
        ) from None
    return Status
