"""Executable `detector`: the lifecycle node as a process."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Sequence

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from yolov5_lifecycle.ros.node import DetectorNode

_PARAMETER_FILE_FLAG = "--params-file"
# Python runs signal handlers between two waits of the executor; this bounds how long one waits.
_SPIN_S = 0.2


def main(args: Sequence[str] | None = None) -> int:
    """Spin the node until a signal or its shutdown; 0 after a clean release, 1 when inference had to be left behind."""
    arguments = list(sys.argv if args is None else args)
    node = DetectorNode(parameter_file_error=_initialise(arguments), arguments=arguments)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    executor.create_task(node.autostart)
    _spin(executor, node, stop)
    rested = node.close()
    rclpy.try_shutdown()
    logging.shutdown()
    if not rested or node.is_loading:
        # A thread inside torch cannot be ended, and the interpreter would abort under it.
        os._exit(0 if rested else 1)
    return 0


def _initialise(args: list[str]) -> str:
    """Start rclpy without its signal handlers, which would kill the context before the node could release.

    A parameter file that cannot be parsed is left out; what is wrong with it is returned.
    """
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        return ""
    except Exception as error:
        if _PARAMETER_FILE_FLAG not in args:
            raise
        problem = str(error).partition("Error: ")[2] or str(error)
    rclpy.init(args=_without_parameter_files(args), signal_handler_options=SignalHandlerOptions.NO)
    return f"the parameter file cannot be read: {problem}. Correct the file and start again."


def _without_parameter_files(args: list[str]) -> list[str]:
    return [
        word
        for word, before in zip(args, ["", *args], strict=False)
        if _PARAMETER_FILE_FLAG not in (word, before)
    ]


def _spin(executor: SingleThreadedExecutor, node: DetectorNode, stop: threading.Event) -> None:
    while not stop.is_set() and node.state_label != "finalized":
        try:
            executor.spin_once(timeout_sec=_SPIN_S)
        except ExternalShutdownException:
            return
        except Exception as error:
            node.get_logger().error(
                f"unexpected {type(error).__name__} in a callback: {error}", throttle_duration_sec=1.0
            )


if __name__ == "__main__":
    sys.exit(main())
