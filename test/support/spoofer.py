"""A node of the ROS domain that sends under the names of others."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.msg import ParameterEvent
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from support.lone_node import lone_node

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Every subscription of the console accepts it."""
_RATE_HZ = 1000.0
_SERVICES = {
    "get_state": GetState,
    "change_state": ChangeState,
    "get_available_transitions": GetAvailableTransitions,
}


def parameter_event(node: str, name: str, value: object) -> ParameterEvent:
    """The event that the parameter `name` of `node` has changed to `value`."""
    return ParameterEvent(node=node, changed_parameters=[Parameter(name, value=value).to_parameter_msg()])


@contextmanager
def flood(node: Node, topic: str, message: Any) -> Iterator[None]:
    """Send `message` on `topic` a thousand times a second until the end of the block."""
    publisher = node.create_publisher(type(message), topic, LATCHED)
    is_over = threading.Event()

    def send() -> None:
        while not is_over.wait(1 / _RATE_HZ):
            publisher.publish(message)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
        node.destroy_publisher(publisher)


@contextmanager
def managed_nodes(names: list[str], *, like_detectors: bool) -> Iterator[None]:
    """Nodes called `names` that are managed, publish diagnostics and answer nothing.

    `like_detectors`: they have all services of a detector.
    """
    with lone_node("crowd") as crowd:
        nodes = [rclpy.create_node(name, context=crowd.context) for name in names]
        try:
            for node in nodes:
                _disguise(node, _SERVICES | ({"collect": Trigger} if like_detectors else {}))
            yield
        finally:
            for node in nodes:
                node.destroy_node()


def _disguise(node: Node, services: dict[str, Any]) -> None:
    for service, kind in services.items():
        node.create_service(kind, f"{node.get_fully_qualified_name()}/{service}", lambda _, answer: answer)
    node.create_publisher(DiagnosticArray, "/diagnostics", 10)
