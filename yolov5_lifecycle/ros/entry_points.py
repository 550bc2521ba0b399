"""Entry points of the nodes: each prepares the process, then imports and runs its node."""

from __future__ import annotations

import sys
from functools import partial
from importlib import import_module
from typing import NoReturn

from yolov5_lifecycle.commands.entry_points import EXIT_UNABLE, prepare_process
from yolov5_lifecycle.process.memory import prepare_heap
from yolov5_lifecycle.process.missing_package import import_problem
from yolov5_lifecycle.process.standard_streams import complain

_ROS_THREADS = 12
"""Eight threads of Fast DDS, plus those of the node and rclpy."""


def _run(command: str, module: str) -> NoReturn:
    """Prepare the process, then run `main` of `module`; exit with code 1 if an import fails.

    Until a node handles signals itself, each ends the process with code 0: the imports take seconds, and a
    signal would otherwise cause a traceback or kill Python. They also start threads.
    """
    prepare_heap()
    prepare_process(command, signal_code=0, further_threads=_ROS_THREADS)
    try:
        main = import_module(module).main
    except ImportError as error:
        remedy = "The node runs with the Python that built it: see docs/colcon.md."
        complain(command, f"{import_problem(error)}. {remedy}")
        sys.exit(EXIT_UNABLE)
    sys.exit(main())


detector = partial(_run, "detector", "yolov5_lifecycle.ros.detector.command")
camera = partial(_run, "camera", "yolov5_lifecycle.ros.camera.node")
console = partial(_run, "console", "yolov5_lifecycle.ros.console.command")
