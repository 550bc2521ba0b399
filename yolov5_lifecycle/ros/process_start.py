"""What must be settled in a node's process before the node's modules are imported."""

from __future__ import annotations

import os
import signal
import sys
from typing import NoReturn

from yolov5_lifecycle.heap import prepare_heap
from yolov5_lifecycle.one_line import in_one_line


def prepare_process() -> None:
    """End with code 0 at SIGINT and SIGTERM from now on; make the heap one for images.

    The imports to come take seconds, in which Python would answer with a traceback or die of the signal. They
    also begin threads.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    prepare_heap()


def refuse_python(command: str, error: ImportError) -> NoReturn:
    """End with code 1 and one line: what is missing, for which Python, and why it may be the wrong one."""
    problem = in_one_line(str(error))
    sys.stderr.write(
        f"{command}: {sys.executable} cannot import what the node needs: {problem}. The node runs with the "
        "Python that built it, which needs torch, pydantic 2, safetensors and a sourced ROS: build the "
        "workspace as README.md says under 'In a colcon workspace'.\n"
    )
    sys.exit(1)
