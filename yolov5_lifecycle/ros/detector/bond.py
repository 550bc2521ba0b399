"""The node's side of a bond with a lifecycle manager, compatible with Nav2.

Both sides send `bond/msg/Status` on the topic `bond`. The manager acts when the node's heartbeats stop; this
node, like Nav2's nodes, stays active when the manager's stop.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable
from itertools import takewhile
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import Node

from yolov5_lifecycle.process.missing_package import apt_package_of
from yolov5_lifecycle.ros.rclpy_internals import take_message

TOPIC = "bond"
CONNECT_S = 10.0
"""Time to wait for the other side to connect; the protocol's default."""
_HEARTBEAT_S = 0.1  # as Nav2's nodes and lifecycle manager use
_SHORTEST_HEARTBEAT_S = 0.01
_HEARTBEATS_IN_TIMEOUT = 4
_DEPTH = 100
_DELIVERY_S = 0.1  # bondcpp waits this long, too, for the other side to receive the end of the bond


def check_bond(timeout_s: float) -> None:
    """Raise ValueError with the remedy if `timeout_s` is not 0 and the bond messages are not installed."""
    if timeout_s:
        _status_type(timeout_s)


class _Polled(CallbackGroup):
    """Callback group whose subscriptions do not wake the executor; the heartbeat timer polls them.

    All Nav2 nodes publish on one topic, about 200 messages per second, of which ten matter here.
    """

    def can_execute(self, _: object) -> bool:
        return False


class Bond:
    """This side of one bond: publishes heartbeats of `node` on the topic `bond`, several per `timeout_s`.

    It lasts from construction to `close`. Its id is the node's name, its instance id is unique.

    `clock` returns monotonic seconds.
    """

    def __init__(self, node: Node, timeout_s: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._status_type = _status_type(timeout_s)
        self._node = node
        self._clock = clock
        self._timeout_s = timeout_s
        self._period_s = max(_SHORTEST_HEARTBEAT_S, min(_HEARTBEAT_S, timeout_s / _HEARTBEATS_IN_TIMEOUT))
        self._instance_id = str(uuid.uuid4())
        self._is_joined = self._is_missed = self._is_over = False
        """A manager has sent a heartbeat; it sends none any more; the bond broke or was never formed."""
        self._heard_s = clock()
        self._publisher = node.create_publisher(self._status_type, TOPIC, 5)
        self._subscription = node.create_subscription(
            self._status_type, TOPIC, self._take, _DEPTH, callback_group=_Polled()
        )
        # Steady time: simulated time may be paused.
        self._timer = node.create_timer(
            self._period_s, self._beat, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    def close(self) -> None:
        """Notify the manager that the bond ends and stop the heartbeats; takes at most 0.1 s."""
        if not self._is_over:
            self._publish(is_active=False)
            self._publisher.wait_for_all_acked(Duration(seconds=_DELIVERY_S))
        self._node.destroy_timer(self._timer)
        self._node.destroy_subscription(self._subscription)
        self._node.destroy_publisher(self._publisher)

    def _beat(self) -> None:
        waiting = (take_message(self._subscription, self._status_type) for _ in range(_DEPTH))
        for message in takewhile(lambda message: message is not None, waiting):
            self._take(message)
        if self._is_over:
            return
        silent_s = self._clock() - self._heard_s
        if not self._is_joined and silent_s > CONNECT_S:
            self._end(f"no lifecycle manager joined the bond within {CONNECT_S:g} s")
            return
        if self._is_joined and not self._is_missed and silent_s > self._timeout_s:
            self._is_missed = True
            self._node.get_logger().warning(
                f"no heartbeat from the lifecycle manager for {self._timeout_s:g} s; detection continues"
            )
        self._publish(is_active=True)

    def _take(self, message: Any) -> None:
        is_other_side = message.id == self._node.get_name() and message.instance_id != self._instance_id
        if not is_other_side or self._is_over:
            return
        if not message.active:
            self._publish(is_active=False)  # acknowledges the end, for which the other side waits
            self._end("the lifecycle manager ended the bond")
            return
        self._heard_s = self._clock()
        if not self._is_joined or self._is_missed:
            self._node.get_logger().info("bonded with the lifecycle manager")
        self._is_joined, self._is_missed = True, False

    def _end(self, reason: str) -> None:
        self._is_over = True
        self._timer.cancel()
        self._node.get_logger().warning(
            f"{reason}; detection continues without heartbeats until the next activation"
        )

    def _publish(self, *, is_active: bool) -> None:
        message = self._status_type(
            id=self._node.get_name(),
            instance_id=self._instance_id,
            active=is_active,
            heartbeat_timeout=self._timeout_s,
            heartbeat_period=self._period_s,
        )
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


def _status_type(timeout_s: float) -> Any:
    """Import bond/msg/Status, which only a bond needs; raise ValueError with the remedy."""
    try:
        from bond.msg import Status
    except ImportError as error:
        raise ValueError(
            f"bond_timeout {timeout_s:g} needs the ROS package 'bond', which is not installed ({error}). "
            f"Restart the node after `sudo apt install {apt_package_of('bond')}`, or with bond_timeout 0.0."
        ) from None
    return Status
