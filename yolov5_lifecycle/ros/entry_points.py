"""Entry points of the nodes: each prepares the process, then imports and runs its node."""

from __future__ import annotations

import sys
from typing import NoReturn

from yolov5_lifecycle.commands.entry_points import EXIT_UNABLE, prepare_process
from yolov5_lifecycle.process.memory import prepare_heap
from yolov5_lifecycle.process.missing_package import import_problem
from yolov5_lifecycle.process.standard_streams import complain
from yolov5_lifecycle.ros.shared_memory import warn_before_import

_ROS_THREADS = 12
"""Eight threads of Fast DDS, plus those of the node and rclpy."""


def detector() -> NoReturn:
    """Run the command `detector`; exit with code 1 if an import fails."""
    _prepare_node_process("detector")
    try:
        from yolov5_lifecycle.ros.detector import command
    except ImportError as error:
        _refuse_python("detector", error)
    command.main()


def camera() -> NoReturn:
    """Run the command `camera`; exit with code 1 if an import fails."""
    _prepare_node_process("camera")
    try:
        from yolov5_lifecycle.ros.camera import node
    except ImportError as error:
        _refuse_python("camera", error)
    node.main()


def console() -> NoReturn:
    """Run the command `console`; exit with code 1 if an import fails."""
    _prepare_node_process("console")
    try:
        from yolov5_lifecycle.ros.console import command
    except ImportError as error:
        _refuse_python("console", error)
    command.main()


def _prepare_node_process(command: str) -> None:
    """Prepare the process; until the node handles signals itself, each ends it with code 0.

    The imports that follow take seconds, during which a signal would otherwise cause a traceback or kill
    Python. They also start threads.
    """
    prepare_heap()
    prepare_process(command, signal_code=0, further_threads=_ROS_THREADS)
    warn_before_import(command)


def _refuse_python(command: str, error: ImportError) -> NoReturn:
    """Exit with code 1 after reporting the failed import, the Python used and the Python required."""
    complain(
        command,
        f"{import_problem(error)}. The node runs with the Python that built it: see docs/colcon.md.",
    )
    sys.exit(EXIT_UNABLE)
