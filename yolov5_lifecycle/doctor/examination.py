"""Examinations: groups of checks, each in a process of its own, which may crash or hang."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, replace
from importlib import import_module
from pathlib import Path

from yolov5_lifecycle.doctor.finding import Check, Finding, Machine, error
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.missing_package import remedy_for

TIME_S = 120.0
"""For all examinations together; the patience of each is meant for this time."""
MOST_CAMERAS = 8
"""The others are not opened."""
_LAST_LINES = 4
_DEATH_S = 2.0
"""A process inside a hanging driver does not even die of SIGKILL."""
_PROGRAM = (
    "import sys; sys.path[:] = filter(None, sys.path); "  # no modules from the current folder
    "from yolov5_lifecycle.doctor.examination import write_findings; write_findings(*sys.argv[1:])"
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
_DRIVER = "Restart the machine; if the driver still does not answer, install it again."
_DEVICES = "Set device to cpu and restart the machine: a GPU that hangs recovers no other way."
_RUNTIME = (
    "Uninstall the package {target}, or set runtime to torch, because `auto` may choose a runtime that hangs."
)
_CAMERA = "Plug the camera in again, at another port or without a hub, because it is open but sends nothing."
_EXAMINATIONS = (
    Examination("system", "yolov5_lifecycle.doctor.system", 10, _REPORT),
    Examination("packages", "yolov5_lifecycle.doctor.python_packages", 30, _REPORT),
    Examination("ros", "yolov5_lifecycle.ros.doctor.environment", 20, f"{_FIRST} {_REPORT}"),
    Examination("driver", "yolov5_lifecycle.doctor.system", 10, _DRIVER),
    Examination("devices", "yolov5_lifecycle.doctor.inference", 40, f"{_DEVICES} {_REPORT}"),
    Examination("runtime", "yolov5_lifecycle.doctor.inference", 30, _RUNTIME, "onnxruntime"),
    Examination("runtime", "yolov5_lifecycle.doctor.inference", 30, _RUNTIME, "openvino"),
    Examination("transport", "yolov5_lifecycle.ros.doctor.started_nodes", 35, f"{_FIRST} {_REPORT}"),
    Examination("node", "yolov5_lifecycle.ros.doctor.started_nodes", 75, f"{_FIRST} {_REPORT}"),
)
NAMES = tuple(dict.fromkeys([*(each.name for each in _EXAMINATIONS), "camera"]))
"""What `--only` takes."""


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
    code, answer, last_words = _run(examination, root, patience_s)
    rows = [json.loads(line) for line in answer.split("\n")[:-1]]
    findings = [Finding(*row) for row in rows if len(row) > 1]
    if [] not in rows:
        subjects = [row[0] for row in rows if len(row) == 1] or [str(examination)]
        failure = error(
            _early_end(code, patience_s, last_words), remedy=examination.suspect.format(**vars(examination))
        )
        findings.append(replace(failure, subject=subjects[-1]))
    return findings


def _run(examination: Examination, root: Path, patience_s: float) -> tuple[int | None, str, str]:
    """The exit code, None for none within `patience_s`, and the whole stdout and stderr.

    They are files in memory: a pipe ends only with all that the process has started, and a disk may be full.
    """
    words = [sys.argv[0], examination.module, examination.name, str(root), examination.target]
    answer, last_words = (os.fdopen(os.memfd_create(name), "w+b") for name in ("stdout", "stderr"))
    with answer, last_words:
        process = subprocess.Popen(
            [sys.executable, "-c", _PROGRAM, *words],
            stdin=subprocess.DEVNULL,
            stdout=answer,
            stderr=last_words,
            start_new_session=True,
        )
        code = None
        try:
            with suppress(subprocess.TimeoutExpired):
                code = process.wait(patience_s)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            with suppress(subprocess.TimeoutExpired):
                process.wait(_DEATH_S)
        for file in (answer, last_words):
            file.seek(0)
        return code, answer.read().decode(errors="replace"), last_words.read().decode(errors="replace")


def _early_end(code: int | None, patience_s: float, last_words: str) -> str:
    """How the process ended before its last check, and the last lines of its stderr."""
    if code is None:
        end = f"no answer within {patience_s:.0f} s"
    else:
        end = f"it ended with {signal.strsignal(-code) if code < 0 else f'exit code {code}'}"
    lines = [line for line in last_words.splitlines() if line.strip()]
    said = in_one_line(" | ".join(lines[-_LAST_LINES:]), 400)
    return f"{end}; what follows in this group was not checked. {said}".removesuffix(". ")


def write_findings(command: str, module: str, group: str, root: str, target: str) -> None:
    """Make all checks of the group, and end the process.

    Writes JSON lines: [subject] of each check before it begins, then its findings; [] at the end. A check
    that raises becomes an error. Whatever else writes to stdout goes to stderr.
    """
    sys.argv = [command]  # beside it lie the other commands
    prepare_environment()
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)
        for row in _rows(_checks(module, group), Machine(Path(root), target)):
            print(json.dumps(row), file=answers, flush=True)
    os._exit(0)  # the libraries of a broken machine may crash or hang when they are unloaded


def _rows(checks: Mapping[str, Check], machine: Machine) -> Iterator[Sequence[str]]:
    for subject, check in checks.items():
        named = f"{subject} {machine.target}".strip()
        yield [named]
        try:
            for finding in check(machine):
                yield astuple(replace(finding, subject=named))
        except (Exception, SystemExit) as problem:  # noqa: BLE001 - a broken package raises anything
            yield astuple(replace(_failure(problem), subject=named))
    yield []


def _checks(module: str, group: str) -> dict[str, Check]:
    """The checks by subject; if `module` cannot be imported, one that says so."""
    try:
        return dict(import_module(module).CHECKS[group])
    except (Exception, SystemExit) as problem:  # noqa: BLE001 - as above
        finding = _failure(problem)
        return {group: lambda _: iter([finding])}


def _failure(problem: BaseException) -> Finding:
    found = in_one_line(f"{type(problem).__name__}: {problem}", 400)
    if isinstance(problem, ImportError):
        return error(found, remedy=remedy_for(problem))
    return error(found, remedy="Correct the errors above first; if there are none, report this line.")
