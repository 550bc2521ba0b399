"""Executable `detector`: the lifecycle node as a process."""

from __future__ import annotations

import gc
import os
import re
import sys
from collections.abc import Sequence
from typing import NoReturn

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from yolov5_lifecycle.preparation import Prepare, prepare_model
from yolov5_lifecycle.ros.command_line import complain, explain
from yolov5_lifecycle.ros.misaddressed_files import PARAMETER_FILE_FLAG, warnings
from yolov5_lifecycle.ros.node import DetectorNode
from yolov5_lifecycle.ros.process import spin, stop_event
from yolov5_lifecycle.settings import SETTINGS

_USAGE = """\
detector: finds objects in the images on ~/image_raw and publishes them on ~/detections.
Parameters are given as in `detector --ros-args -p device:=cpu --params-file config/yolov5.yaml`:"""

# So long the inference thread may have to wait for Python while an image is taken; docs/performance.md tells
# what Python's own 5 ms cost.
_SWITCH_S = 0.0002

EXIT_DEVICE_LOST = 3
"""The GPU has given this process up; start a new one."""


def main(args: Sequence[str] | None = None, *, prepare: Prepare = prepare_model) -> NoReturn:
    """Spin the node until a signal or its shutdown, release everything, and end the process with code 0.

    The code is 2 for a command line that is not understood, EXIT_DEVICE_LOST when the GPU is lost. `prepare`
    makes the models; see `DetectorNode`.
    """
    code = _run(list(sys.argv if args is None else args), prepare)
    # Python and torch would take seconds to clear away what the system takes back at once, and abort under a
    # thread that is still at work inside torch.
    sys.stdout.flush()
    os._exit(code)


def _run(arguments: list[str], prepare: Prepare) -> int:
    stop = stop_event()
    try:
        problem = _initialise(arguments)
        if words := remove_ros_args(_without_parameter_files(arguments))[1:]:
            return explain("detector", words, usage=_USAGE, parameters=_parameters())
        node = DetectorNode(prepare=prepare, parameter_file_error=problem, arguments=arguments)
    except (RuntimeError, ParameterException) as error:
        return complain("detector", f"ROS refuses to start: {error}")
    for warning in warnings(arguments, node.get_fully_qualified_name()):
        node.get_logger().warning(warning)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    autostart = executor.create_task(node.autostart)
    # Torch and pydantic leave 300,000 objects for ever; to look at them again would hold all threads 0.15 s.
    gc.freeze()
    sys.setswitchinterval(_SWITCH_S)
    spin(
        executor,
        node,
        until=lambda: stop.is_set() or node.device_lost or node.state_label == "finalized",
    )
    if node.device_lost:
        return EXIT_DEVICE_LOST  # nothing on a dead device can be released
    autostart.cancel()  # of one that has not begun, Python would say that it was never awaited
    node.close()
    rclpy.try_shutdown()
    return 0


def _parameters() -> list[tuple[str, str | None, object]]:
    return [(setting.name, setting.description, setting.default) for setting in SETTINGS]


def _initialise(args: list[str]) -> str:
    """Start rclpy without its signal handlers, which would kill the context before the node could release.

    A parameter file that cannot be parsed is left out; what is wrong with it is returned.
    """
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        return ""
    except RuntimeError as error:
        if PARAMETER_FILE_FLAG not in args:
            raise
        problem = re.sub(
            r".*'--params-file (.*)'. Error: (.*?), at /.*", r"\1: \2", str(error), flags=re.DOTALL
        )
    rclpy.init(args=_without_parameter_files(args), signal_handler_options=SignalHandlerOptions.NO)
    return f"the parameter file cannot be read: {problem}. Correct the file and start again."


def _without_parameter_files(args: list[str]) -> list[str]:
    return [
        word
        for word, before in zip(args, ["", *args], strict=False)
        if PARAMETER_FILE_FLAG not in (word, before)
    ]


if __name__ == "__main__":
    main()
