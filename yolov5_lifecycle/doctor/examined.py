"""The process of an examination: runs the checks of one module and writes what they find."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TextIO

from yolov5_lifecycle.doctor.finding import Check, Finding, Machine, error
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.environment import prepare_environment
from yolov5_lifecycle.process.missing_package import remedy_for

PROGRAM = (
    "import sys; sys.path[:] = filter(None, sys.path); "  # no modules from the current folder
    "from yolov5_lifecycle.doctor.examined import main; main()"
)
"""Runs `main`; its arguments: module, root of the machine, target, number of checks to skip, command."""


def main() -> None:
    """Write JSON lines: the subject of each check before it begins, then its findings; {} at the end.

    A check that raises becomes an error. Whatever else writes to stdout goes to stderr. Ends the process.
    """
    name, root, target, skipped, command = sys.argv[1:6]
    sys.argv = [command]  # beside it lie the other commands
    prepare_environment()
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for subject, check in list(_checks(name).items())[int(skipped) :]:
        _write(answers, subject=f"{subject} {target}".strip())
        for finding in _found(check, Machine(Path(root), target)):
            _write(answers, **asdict(finding))
    _write(answers)
    os._exit(0)  # the libraries of a broken machine may crash or hang when they are unloaded


def _checks(module: str) -> dict[str, Check]:
    """The checks of `module` by subject; if it cannot be imported, one that says so."""
    try:
        return dict(import_module(module).CHECKS)
    except (Exception, SystemExit) as problem:  # noqa: BLE001 - a broken package raises anything
        finding = _failure(problem)
        return {module.rpartition(".")[2]: lambda _: iter([finding])}


def _found(check: Check, machine: Machine) -> Iterator[Finding]:
    """What the check finds until its end, or until it raises."""
    try:
        yield from check(machine)
    except (Exception, SystemExit) as problem:  # noqa: BLE001 - as above
        yield _failure(problem)


def _failure(problem: BaseException) -> Finding:
    found = in_one_line(f"{type(problem).__name__}: {problem}", 400)
    if isinstance(problem, ImportError):
        return error(found, remedy=remedy_for(problem))
    return error(found, remedy="Correct the errors above first; if there are none, report this line.")


def _write(answers: TextIO, **answer: str) -> None:
    answers.write(json.dumps(answer) + "\n")
    answers.flush()
