"""Command `detector`: what must be settled before the node's modules are imported."""

from __future__ import annotations

import os
import signal
import sys
from typing import NoReturn

from yolov5_lifecycle.heap import prepare_heap


def main() -> NoReturn:
    """End with code 0 at SIGINT and SIGTERM from now on, then import the node and run it.

    The imports take seconds, in which Python would answer with a traceback or die of the signal. They also
    begin threads. The code is 1 when something cannot be imported.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os._exit(0))
    prepare_heap()

    try:
        from yolov5_lifecycle.ros import detector
    except ImportError as error:
        _refuse(error)
    detector.main()


def _refuse(error: ImportError) -> NoReturn:
    """End with one line: what is missing, for which Python, and why it may be the wrong one."""
    problem = " ".join(str(error).split())
    sys.stderr.write(
        f"detector: {sys.executable} cannot import what the node needs: {problem}. The node runs with the "
        "Python that built it, which needs torch, pydantic 2, safetensors and a sourced ROS: build the "
        "workspace as README.md says under 'In a colcon workspace'.\n"
    )
    sys.exit(1)
