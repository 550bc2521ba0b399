"""Executable `doctor`: checks this machine and prints a report that may be published."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser, version_line
from yolov5_lifecycle.doctor.examination import Examination, examine
from yolov5_lifecycle.doctor.examinations import NAMES, TIME_S, planned
from yolov5_lifecycle.doctor.finding import Line, error
from yolov5_lifecycle.doctor.report import as_json, as_text, public, summary
from yolov5_lifecycle.process.standard_streams import write_output

EXIT_ERRORS = 1
"""Exit code if a line of the report is an error."""
_LEAST_S, _MOST_S = 10.0, 3600.0


def main(
    argv: Sequence[str] | None = None,
    *,
    root: Path = Path("/"),
    now_s: Callable[[], float] = time.monotonic,
) -> int:
    """Run the examinations; return 0 without errors, 1 with errors, or that of an output that failed.

    `root`: the folder in which /proc, /sys, /etc and /dev of the machine lie.
    """
    given = _arguments(argv)
    begun_s = now_s()
    code = (
        0
        if given.json
        else write_output("doctor", f"{version_line('doctor')}: takes at most {given.time:g} s\n")
    )
    lines = []
    for line in _examined(root, given.only or NAMES, given.time, now_s):
        lines.append(line)
        if not given.json and code == 0:
            code = write_output("doctor", as_text(line) + "\n")
    duration_s = now_s() - begun_s
    end = as_json(lines, duration_s) if given.json else summary(lines, duration_s)
    code = code or write_output("doctor", end + "\n")
    has_errors = any(line.finding.level == "error" for line in lines)
    return code or (EXIT_ERRORS if has_errors else 0)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(
        "doctor",
        description="Check this machine: system, packages, ROS, devices, runtimes, cameras, image transport "
        "and the node's whole life. The report has no names of people or machines: paste it into an issue.",
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", choices=NAMES, help=f"make only these checks: {', '.join(NAMES)}"
    )
    parser.add_argument(
        "--time",
        type=float,
        default=TIME_S,
        metavar="SECONDS",
        help="how long all checks together may take (default %(default)g); more for a slow machine",
    )
    given = parser.parse_args(argv)
    if not _LEAST_S <= given.time <= _MOST_S:
        parser.error(f"--time: expected {_LEAST_S:g} to {_MOST_S:g} seconds, found {given.time:g}")
    return given


def _examined(root: Path, names: Sequence[str], time_s: float, now_s: Callable[[], float]) -> Iterator[Line]:
    """The lines of the examinations, as soon as each is known."""
    end_s = now_s() + time_s
    for examination in planned(root):
        if examination.name in names:
            yield from map(public, _lines(examination, root, time_s, end_s - now_s()))


def _lines(examination: Examination, root: Path, time_s: float, left_s: float) -> list[Line]:
    if left_s <= 0:
        finding = error(
            f"not examined, because the {time_s:g} s are over",
            remedy=f"`doctor --only {examination.name}`, or `doctor --time 600` on a slow machine.",
        )
        return [Line(str(examination), finding)]
    patience_s = min(left_s, examination.patience_s * time_s / TIME_S)
    return examine(examination, root=root, patience_s=patience_s)
