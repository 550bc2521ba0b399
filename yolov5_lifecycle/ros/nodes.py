"""What every node of this package has: a printable log, a loop that goes on, a word about its namesakes."""

from __future__ import annotations

import os
import socket
import threading
import traceback
from collections.abc import Callable
from typing import Any

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.logging_severity import LoggingSeverity
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.node import Node

from yolov5_lifecycle.printable import in_lines, in_one_line
from yolov5_lifecycle.process.termination import on_termination
from yolov5_lifecycle.ros.rclpy_internals import attribute_logs_to_callers_of

attribute_logs_to_callers_of(__file__)

# Max duration of one executor wait; Python runs signal handlers only between two waits.
_SPIN_S = 0.2


class PrintableLogger(RcutilsLogger):
    """rclpy logger whose messages are bounded and made printable by `in_lines`."""

    def log(self, message: object, severity: LoggingSeverity, **kwargs: Any) -> bool:
        return bool(super().log(in_lines(str(message)), severity, **kwargs))


class PrintableNode(Node):
    """Node with a `PrintableLogger`, which also handles rclpy's own messages."""

    def __init__(self, name: str, **options: Any) -> None:
        self._printable_logger: PrintableLogger | None = None  # rclpy logs while it constructs the node
        super().__init__(name, **options)

    def get_logger(self) -> RcutilsLogger:
        if self._printable_logger is None:
            self._printable_logger = PrintableLogger(super().get_logger().name)
        return self._printable_logger


def stop_event() -> threading.Event:
    """Return an event that SIGINT, SIGTERM and SIGHUP set from now on.

    Requires rclpy.init(signal_handler_options=SignalHandlerOptions.NO): rclpy's own handlers would shut the
    context down before a node can release its resources.
    """
    stop = threading.Event()
    on_termination(lambda _: stop.set())
    return stop


def spin(executor: SingleThreadedExecutor, node: Node, *, until: Callable[[], bool]) -> None:
    """Spin until `until()`, polled several times per second, or until the context is shut down.

    An exception in a callback is logged, not fatal.
    """
    while node.context.ok() and not until():
        _spin_once(executor, node)


def _spin_once(executor: SingleThreadedExecutor, node: Node) -> None:
    try:
        executor.spin_once(timeout_sec=_SPIN_S)
    except ExternalShutdownException:
        pass  # the caller checks the context
    except Exception as error:  # noqa: BLE001 - a failed callback must not stop the others
        node.get_logger().error(
            f"unexpected {type(error).__name__} in a callback:\n{traceback.format_exc()}",
            throttle_duration_sec=1.0,
        )


def namesakes(node: Node) -> str:
    """That other nodes have the name of `node`, and what to do; "" if there are none.

    ROS allows it, although services and parameters then reach either one.
    """
    own = node.get_name(), node.get_namespace()
    count = node.get_node_names_and_namespaces().count(own)
    if count < 2:
        return ""
    others = "another" if count == 2 else f"{count - 1} others"
    return (
        f"{count} nodes in this domain are named {node.get_fully_qualified_name()}: this one (host "
        f"{in_one_line(socket.gethostname())}, process {os.getpid()}) and {others}. Requests and parameters "
        "reach either of them. Restart one with `--ros-args -r __node:=another_name`. Every detector among "
        "them shows its host and process in /diagnostics; a killed one is listed for up to 20 s"
    )
