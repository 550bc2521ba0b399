"""Preparation of a command's process before numpy, torch or rclpy are imported."""

from __future__ import annotations

import sys

from yolov5_lifecycle.commands.version import version_line
from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.standard_streams import complain, open_standard_streams, write_output
from yolov5_lifecycle.process.termination import end_at_once
from yolov5_lifecycle.process.thread_limit import compute_threads, thread_problem

EXIT_UNABLE = 1
"""Exit code if the machine or its Python lacks what the command needs."""


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
    if problem := thread_problem(further_threads + 2 * compute_threads()):
        complain(command, problem)
        sys.exit(EXIT_UNABLE)
