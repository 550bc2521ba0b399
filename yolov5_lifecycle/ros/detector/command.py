"""Command `detector`: the node until a signal or its shutdown, then its exit code."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from collections.abc import Sequence
from typing import NoReturn

import rclpy
from rclpy.exceptions import ParameterException

from yolov5_lifecycle.detection.prepared_model import Prepare, prepare_model
from yolov5_lifecycle.process.standard_streams import flush_output
from yolov5_lifecycle.ros.detector.node import DetectorNode
from yolov5_lifecycle.ros.nodes import spin, stop_event
from yolov5_lifecycle.ros.rclpy_internals import ResilientExecutor
from yolov5_lifecycle.ros.shared_memory import shared_memory_problems
from yolov5_lifecycle.ros.start_arguments import (
    explain,
    initialize,
    misaddressed_files,
    refuse,
    start_arguments,
)
from yolov5_lifecycle.settings.settings import SETTINGS

FINALIZED_S = 5.0
"""The node goes on answering so long after its shutdown: longer than a lifecycle manager waits for get_state;
Nav2's waits up to 2 s."""
_USAGE = """\
detector: finds objects in the images on ~/image_raw and publishes them on ~/detections.
Pass parameters as in `detector --ros-args -p device:=cpu --params-file config/yolov5.yaml`:"""

# Max time the inference thread waits for the GIL while an image is taken; docs/performance.md has the cost
# of Python's default of 5 ms.
_SWITCH_S = 0.0002


def main(args: Sequence[str] | None = None, *, prepare: Prepare = prepare_model) -> NoReturn:
    """Spin the node until a signal or its shutdown, release everything, and exit with code 0.

    The exit code is 2 for invalid arguments, else see `DetectorNode`. `prepare` creates the models.
    """
    code = _run(list(sys.argv if args is None else args), prepare)
    # Without os._exit, Python and torch would take seconds to free what the OS reclaims at once, and would
    # abort if a thread is still running inside torch.
    flush_output("detector", code)  # the reader of the pipe may have exited
    os._exit(code)


def _run(arguments: list[str], prepare: Prepare) -> int:
    stop = stop_event()
    shortages = shared_memory_problems()
    try:
        given = start_arguments(arguments)
        if words := given.own_words:
            return explain("detector", words, usage=_USAGE, settings=SETTINGS)
        initialize(given.words)
        node = DetectorNode(prepare=prepare, start_problems=given.problems)
    except (RuntimeError, ParameterException) as error:
        return refuse("detector", f"cannot start: {error}")
    for warning in (*shortages, *misaddressed_files(given.files, node.get_fully_qualified_name())):
        node.get_logger().warning(warning)
    return _serve(node, stop)


def _serve(node: DetectorNode, stop: threading.Event) -> int:
    """Spin `node` until it ends, release everything, and return the exit code."""
    executor = ResilientExecutor()
    executor.add_node(node)
    autostart = executor.create_task(node.autostart)
    # Torch and pydantic keep 300,000 objects alive; scanning them in a collection blocks all threads 0.15 s.
    gc.freeze()
    sys.setswitchinterval(_SWITCH_S)

    def is_over() -> bool:
        return stop.is_set() or node.exit_code is not None

    spin(executor, node, until=lambda: is_over() or node.state_label == "finalized")
    if node.state_label == "finalized" and not is_over():
        told = f"finalized: everything is released, the process ends in {FINALIZED_S:g} s"
        node.get_logger().info(told)
        end_s = time.monotonic() + FINALIZED_S
        spin(executor, node, until=lambda: is_over() or time.monotonic() >= end_s)
    if node.exit_code is not None:
        return node.exit_code  # neither a dead device nor what a hung thread uses can be released
    autostart.cancel()  # else Python warns "never awaited" if it has not started
    node.close()
    rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    main()
