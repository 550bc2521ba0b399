"""Preparation of a node's process before the node's modules are imported."""

from __future__ import annotations

import sys
from typing import NoReturn

from yolov5_lifecycle.commands.entry_points import EXIT_UNABLE
from yolov5_lifecycle.commands.version import version_line
from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.memory import prepare_heap
from yolov5_lifecycle.process.missing_package import import_problem
from yolov5_lifecycle.process.standard_streams import complain, open_standard_streams, write_output
from yolov5_lifecycle.process.termination import end_at_once
from yolov5_lifecycle.process.thread_limit import compute_threads, thread_problem

_ROS_THREADS = 12
"""Eight threads of Fast DDS, plus those of the node and rclpy."""


def prepare_process(command: str) -> None:
    """Exit with code 0 on SIGINT, SIGTERM and SIGHUP from now on; prepare streams, environment and heap.

    The imports that follow take seconds, during which a signal would otherwise cause a traceback or kill
    Python. They also start threads; exits with code 1 if too few can be started. Prints `--version` and exits
    first, so that it works even where the imports fail.
    """
    open_standard_streams()
    end_at_once(0)
    prepare_environment()
    if sys.argv[1:] == ["--version"]:
        sys.exit(write_output(command, f"{version_line(command)}\n"))
    prepare_heap()
    if problem := thread_problem(_ROS_THREADS + 2 * compute_threads()):
        complain(command, problem)
        sys.exit(EXIT_UNABLE)


def refuse_python(command: str, error: ImportError) -> NoReturn:
    """Exit with code 1 after reporting the failed import, the Python used and the Python required."""
    complain(
        command,
        f"{import_problem(error)}. The node runs with the Python that built it: see README.md, "
        "'In a colcon workspace'.",
    )
    sys.exit(EXIT_UNABLE)
