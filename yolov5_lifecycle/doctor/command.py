"""Executable `doctor`: checks this machine and prints a report that may be published."""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser, version_line
from yolov5_lifecycle.doctor.examination import NAMES, TIME_S, examine, planned
from yolov5_lifecycle.doctor.finding import Finding, error, public
from yolov5_lifecycle.process.standard_streams import write_output

EXIT_ERRORS = 1
"""Exit code if a line of the report is an error."""
_LEAST_S, _MOST_S = 10.0, 3600.0
_LEVEL, _SUBJECT = 8, 20  # columns


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
    findings, code = [], 0

    def show(text: str) -> None:
        nonlocal code
        code = code or write_output("doctor", text + "\n")

    if not given.json:
        show(f"{version_line('doctor')}: takes at most {given.time:g} s")
    for finding in _examined(root, given.only or NAMES, given.time, now_s):
        findings.append(finding)
        if not given.json:
            show(_as_text(finding))
    show((_as_json if given.json else _summary)(findings, now_s() - begun_s))
    has_errors = any(finding.level == "error" for finding in findings)
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


def _examined(
    root: Path, names: Sequence[str], time_s: float, now_s: Callable[[], float]
) -> Iterator[Finding]:
    """What the examinations find, as soon as each has ended, fit to be published."""
    end_s = now_s() + time_s
    for examination in planned(root):
        if examination.name not in names:
            continue
        if (left_s := end_s - now_s()) > 0:
            patience_s = min(left_s, examination.patience_s * time_s / TIME_S)
            yield from map(public, examine(examination, root=root, patience_s=patience_s))
        else:
            finding = error(
                f"not examined, because the {time_s:g} s are over",
                remedy=f"`doctor --only {examination.name}`, or `doctor --time 600` on a slow machine.",
            )
            yield replace(finding, subject=str(examination))


def _as_text(finding: Finding) -> str:
    text = f"{finding.level:<{_LEVEL}} {finding.subject:<{_SUBJECT}} {finding.found}"
    return f"{text}\n{' ' * (_LEVEL + 1)}-> {finding.remedy}" if finding.remedy else text


def _summary(findings: Sequence[Finding], duration_s: float) -> str:
    levels = Counter(finding.level for finding in findings)
    return f"{levels['ok']} ok, {levels['warning']} warnings, {levels['error']} errors in {duration_s:.0f} s"


def _as_json(findings: Sequence[Finding], duration_s: float) -> str:
    lines = [asdict(finding) for finding in findings]
    content = {"version": version_line("doctor"), "duration_s": round(duration_s, 1), "lines": lines}
    return json.dumps(content, indent=2, ensure_ascii=False)
