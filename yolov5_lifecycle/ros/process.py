"""A node as a process: signals that ask it to end, and the loop of its executor."""

from __future__ import annotations

import signal
import threading
import traceback
from collections.abc import Callable

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

# Python runs signal handlers between two waits of the executor; this bounds how long one waits.
_SPIN_S = 0.2


def stop_event() -> threading.Event:
    """An event that SIGINT and SIGTERM set from now on.

    Goes with rclpy.init(signal_handler_options=SignalHandlerOptions.NO): rclpy's own handlers would kill the
    context before a node could release what it owns.
    """
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop


def spin(executor: SingleThreadedExecutor, node: Node, *, until: Callable[[], bool]) -> None:
    """Work until `until()`, asked several times a second, or until somebody else shuts rclpy down.

    An exception in a callback is logged, not fatal.
    """
    while node.context.ok() and not until():
        _spin_once(executor, node)


def _spin_once(executor: SingleThreadedExecutor, node: Node) -> None:
    try:
        executor.spin_once(timeout_sec=_SPIN_S)
    except ExternalShutdownException:
        pass  # the caller asks the context
    except Exception as error:  # noqa: BLE001 - whatever one callback does, the others are served
        node.get_logger().error(
            f"unexpected {type(error).__name__} in a callback:\n{traceback.format_exc()}",
            throttle_duration_sec=1.0,
        )
