"""Executable `doctor`: checks this machine and prints a report that may be published.

Each group of checks, an examination, runs in a process of its own, which may crash or hang.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from importlib import import_module
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser, version_line
from yolov5_lifecycle.doctor.finding import Finding, Level, Machine, error, public
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.missing_package import import_problem
from yolov5_lifecycle.process.standard_streams import write_output

EXIT_ERRORS = 1
"""Exit code if a line of the report is an error."""
_LEAST_S, _MOST_S = 10.0, 3600.0
TIME_S = 120.0
"""For all examinations together; the patience of each is meant for this time."""
MOST_CAMERAS = 8
"""The others are not opened."""
_LAST_LINES = 4
_DEATH_S = 2.0
"""A process inside a hanging driver does not even die of SIGKILL."""
_PROGRAM = (
    "import sys; sys.path[:] = filter(None, sys.path); "  # no modules from the current folder
    "from yolov5_lifecycle.doctor.command import write_findings; write_findings(*sys.argv[1:])"
)


@dataclass(frozen=True)
class Examination:
    """The checks of the group `name` in `module`, for `target` if there is one.

    `suspect`: what to do if they hang or crash, with {name} and {target}.
    """

    name: str
    module: str
    patience_s: float
    suspect: str
    target: str = ""

    def __str__(self) -> str:
        return f"{self.name} {self.target}".strip()


_FIRST = "Correct the errors above first."
_REPORT = "Run `doctor --only {name} --time 600`, which waits longer; if that fails, too, report its output."
_DEMO = "Then run `demo`, which shows every step, and report its output."
_DRIVER = "Restart the machine; if the driver still does not answer, install it again."
_DEVICES = "Set device to cpu and restart the machine: a GPU that hangs recovers no other way."
_RUNTIME = (
    "Uninstall the package {target}, or set runtime to torch, because `auto` may choose a runtime that hangs."
)
_CAMERA = "Plug the camera in again, at another port or without a hub, because it is open but sends nothing."
_EXAMINATIONS = (
    Examination("system", "yolov5_lifecycle.doctor.system", 10, _REPORT),
    Examination("packages", "yolov5_lifecycle.doctor.system", 30, _REPORT),
    Examination("ros", "yolov5_lifecycle.ros.doctor.environment", 20, f"{_FIRST} {_REPORT}"),
    Examination("driver", "yolov5_lifecycle.doctor.system", 10, _DRIVER),
    Examination("devices", "yolov5_lifecycle.doctor.inference", 40, f"{_DEVICES} {_REPORT}"),
    Examination("runtime", "yolov5_lifecycle.doctor.inference", 30, _RUNTIME, "onnxruntime"),
    Examination("runtime", "yolov5_lifecycle.doctor.inference", 30, _RUNTIME, "openvino"),
    Examination("transport", "yolov5_lifecycle.ros.doctor.started_nodes", 35, f"{_FIRST} {_REPORT}"),
    Examination("node", "yolov5_lifecycle.ros.doctor.started_nodes", 75, f"{_FIRST} {_DEMO}"),
)
NAMES = tuple(dict.fromkeys([*(each.name for each in _EXAMINATIONS), "camera"]))
"""What `--only` takes."""


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
    levels = Counter[Level]()
    code = write_output("doctor", f"{version_line('doctor')}: takes at most {given.time:g} s\n")
    for finding in _examined(root, given.only or NAMES, given.time, now_s):
        levels[finding.level] += 1
        remedy = f"         -> {finding.remedy}\n" if finding.remedy else ""
        line = f"{finding.level:<8} {finding.subject:<20} {finding.found}\n{remedy}"
        code = code or write_output("doctor", line)
    counts = f"{levels['ok']} ok, {levels['warning']} warnings, {levels['error']} errors"
    code = code or write_output("doctor", f"{counts} in {now_s() - begun_s:.0f} s\n")
    return code or (EXIT_ERRORS if levels["error"] else 0)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(
        "doctor",
        description="Check this machine: system, packages, ROS, devices, runtimes, cameras, image transport "
        "and the node's whole life. The report has no names of people or machines: paste it into an issue.",
    )
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


def planned(root: Path) -> list[Examination]:
    """All examinations in their order; the cameras come last, because several may take their whole time."""
    found = [device.name for device in (root / "dev").glob("video[0-9]*")]
    names = sorted(found, key=lambda name: (len(name), name))[:MOST_CAMERAS]
    module = "yolov5_lifecycle.doctor.system"
    return [*_EXAMINATIONS, *(Examination("camera", module, 10, _CAMERA, f"/dev/{name}") for name in names)]


def examine(examination: Examination, *, root: Path, patience_s: float) -> list[Finding]:
    """What the checks found within `patience_s`; then their process and its children are killed.

    If a check ends the process, those behind it are not made: a group has its riskiest check last.
    """
    # Files in memory: a pipe ends only with all that the process has started, and a disk may be full.
    answer, output = (os.fdopen(os.memfd_create(name), "w+b") for name in ("answer", "output"))
    with answer, output:
        words = [sys.argv[0], examination.module, examination.name, str(root), examination.target]
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *words, str(answer.fileno())],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            pass_fds=[answer.fileno()],
            start_new_session=True,
        )
        code = _exit_code(process, patience_s)
        answer.seek(0)
        output.seek(0)
        lines, said = answer.read().split(b"\n"), output.read().decode(errors="replace")
    rows = list(map(json.loads, lines[:-1]))
    findings = [Finding(*row) for row in rows if len(row) > 1]
    if [] not in rows:
        subject = rows[-1][0] if rows else str(examination)
        remedy = examination.suspect.format(**vars(examination))
        findings.append(Finding(subject, "error", _early_end(code, patience_s, said), remedy))
    return findings


def _exit_code(process: subprocess.Popen[bytes], patience_s: float) -> int | None:
    """That of `process`, None for none within `patience_s`; what is left of its session is killed."""
    try:
        return process.wait(patience_s)
    except subprocess.TimeoutExpired:
        return None
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_DEATH_S)


def _early_end(code: int | None, patience_s: float, said: str) -> str:
    """How the process ended before its last check, and the last lines of its output."""
    if code is None:
        end = f"no answer within {patience_s:.0f} s"
    else:
        end = f"it ended with {signal.strsignal(-code) if code < 0 else f'exit code {code}'}"
    lines = [line for line in said.splitlines() if line.strip()]
    last_words = " | ".join(in_one_line(line, 400) for line in lines[-_LAST_LINES:])[-400:]
    return f"{end}; what follows in this group was not checked. {last_words}".removesuffix(". ")


def write_findings(command: str, module: str, group: str, root: str, target: str, descriptor: str) -> None:
    """Make all checks of the group, and end the process with exit code 0 if none of them raises.

    Writes JSON lines to the file `descriptor`: [subject] of each check before it begins, then its findings;
    [] after the last one.
    """
    sys.argv = [command]  # beside it lie the other commands
    prepare_environment()
    machine = Machine(Path(root), target)
    with open(int(descriptor), "w", closefd=False) as answer:
        try:
            for subject, check in import_module(module).CHECKS[group].items():
                named = f"{subject} {target}".strip()
                print(json.dumps([named]), file=answer, flush=True)
                for finding in check(machine):
                    print(json.dumps(astuple(replace(finding, subject=named))), file=answer, flush=True)
            print("[]", file=answer, flush=True)
            os._exit(0)  # the libraries of a broken machine may crash or hang when they are unloaded
        except ImportError as problem:
            told = import_problem(problem)
        except (Exception, SystemExit) as problem:  # noqa: BLE001 - a broken package raises anything
            told = f"{type(problem).__name__}: {problem}"
    sys.stderr.write(told)
    sys.stderr.flush()
    os._exit(1)
