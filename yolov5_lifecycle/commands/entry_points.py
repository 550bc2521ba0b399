"""Entry points of the commands: prepare the process before numpy, torch or rclpy are imported, then run.

The nodes have theirs in `ros/entry_points.py`.
"""

from __future__ import annotations

import importlib
import signal
import sys
from collections.abc import Mapping
from functools import partial
from types import MappingProxyType
from typing import NoReturn

from yolov5_lifecycle.commands.command_line import version_line
from yolov5_lifecycle.process.environment import compute_threads, prepare_environment, thread_problem
from yolov5_lifecycle.process.missing_package import import_problem
from yolov5_lifecycle.process.standard_streams import (
    EXIT_NOBODY_READS,
    complain,
    flush_output,
    open_standard_streams,
    write_output,
)
from yolov5_lifecycle.process.termination import end_at_once, on_termination

MODULES: Mapping[str, str] = MappingProxyType(
    {
        "calibrate": "yolov5_lifecycle.offline.calibrate.command",
        "collected": "yolov5_lifecycle.offline.collected.command",
        "convert": "yolov5_lifecycle.commands.convert",
        "demo": "yolov5_lifecycle.ros.demo.command",
        "detect_bag": "yolov5_lifecycle.offline.detect_bag",
        "doctor": "yolov5_lifecycle.doctor.command",
        "evaluate": "yolov5_lifecycle.offline.evaluate.command",
        "fetch_weights": "yolov5_lifecycle.commands.fetch_weights",
    }
)
"""The module of each command; its `main` takes the arguments and returns the exit code."""
ARGUMENTS: Mapping[str, str] = MappingProxyType(
    {
        "calibrate": "yolov5_lifecycle.offline.calibrate.arguments",
        "collected": "yolov5_lifecycle.offline.collected.arguments",
        "detect_bag": "yolov5_lifecycle.offline.detect_bag_arguments",
        "evaluate": "yolov5_lifecycle.offline.evaluate.arguments",
    }
)
"""The module with the argument parser of a command whose module imports libraries that may be missing."""
EXIT_UNABLE = 1
"""Exit code if the machine or its Python lacks what the command needs."""
_EXIT_INTERRUPTED = 128 + signal.SIGINT


def prepare_process(command: str, *, signal_code: int | None = None, further_threads: int = 0) -> None:
    """Prepare standard streams, signals and environment; from now on a signal ends the process at once.

    Its exit code is then `signal_code`, or 128 plus the number of the signal. Prints `--version` and exits
    first, so that it works even where the imports fail. Exits with EXIT_UNABLE if too few threads can be
    started: those of the numerical libraries and `further_threads`.
    """
    open_standard_streams()
    end_at_once(signal_code)
    prepare_environment()
    if sys.argv[1:] == ["--version"]:
        sys.exit(write_output(command, f"{version_line(command)}\n"))
    if problem := thread_problem(further_threads + 3 * compute_threads()):
        complain(command, problem)
        sys.exit(EXIT_UNABLE)


def _run(command: str) -> NoReturn:
    """Run `main` of the command's module and exit with its code, whatever the state of standard streams.

    A signal during the imports ends the process at once; a later one unwinds the command, so that it removes
    unfinished files. The exit code is then 128 plus the signal number.
    """
    prepare_process(command)
    try:
        _check_arguments(command)
        main = importlib.import_module(MODULES[command]).main
    except ImportError as error:
        complain(command, import_problem(error))
        sys.exit(EXIT_UNABLE)
    on_termination(lambda number: sys.exit(128 + number))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code = main()
    except ImportError as error:
        complain(command, import_problem(error))
        code = EXIT_UNABLE
    except BrokenPipeError:
        code = EXIT_NOBODY_READS
    except KeyboardInterrupt:
        complain(command, "interrupted")
        code = _EXIT_INTERRUPTED
    except SystemExit as end:
        code = end.code
    sys.exit(flush_output(command, code))


def _check_arguments(command: str) -> None:
    """Exit if the arguments ask for help or are wrong: neither needs OpenCV, rosbags or torch."""
    if (module := ARGUMENTS.get(command)) is None:
        return
    try:
        importlib.import_module(module).command_parser().parse_args()
    except SystemExit as end:
        sys.exit(flush_output(command, int(end.code or 0)))


calibrate = partial(_run, "calibrate")
collected = partial(_run, "collected")
convert = partial(_run, "convert")
demo = partial(_run, "demo")
detect_bag = partial(_run, "detect_bag")
doctor = partial(_run, "doctor")
evaluate = partial(_run, "evaluate")
fetch_weights = partial(_run, "fetch_weights")
