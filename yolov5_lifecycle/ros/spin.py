"""Signal handling and executor loop of a node's process."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from yolov5_lifecycle.process.termination import on_termination

# Max duration of one executor wait; Python runs signal handlers only between two waits.
_SPIN_S = 0.2


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
