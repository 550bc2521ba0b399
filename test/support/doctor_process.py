"""`doctor` in a process of its own, on a machine that is broken in some way."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from support.colcon_workspace import REPOSITORY
from yolov5_lifecycle.doctor.finding import Finding

_PROGRAM = """
import sys
from pathlib import Path
root, *words = sys.argv[1:]
from yolov5_lifecycle.doctor.command import main
from yolov5_lifecycle.process.termination import on_termination
on_termination(lambda number: sys.exit(128 + number))
sys.exit(main(words, root=Path(root)))
"""
_LINE = re.compile(r"^(ok|warning|error) +(.{20,}?) (\S.*)\n(?: {9}-> (.*)\n)?", re.MULTILINE)


def command(*words: str, root: Path = Path("/"), python: Path | str = sys.executable) -> list[str]:
    """The command line of `doctor` with the arguments `words`; other arguments as below."""
    return [str(python), "-c", _PROGRAM, str(root), *words]


def doctor(*words: str, environment: Mapping[str, str] = {}, **machine: object) -> list[Finding]:
    """The report with the arguments `words`; the exit code is that of a report with or without errors.

    `machine`: the `root`, see `main`, and the `python`.
    """
    run = subprocess.run(
        command(*words, **machine),  # type: ignore[arg-type]
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.stdout, run.stderr
    rows = [
        Finding(subject.strip(), level, found, remedy)
        for level, subject, found, remedy in _LINE.findall(run.stdout)
    ]
    assert run.returncode == any(row.level == "error" for row in rows), run.stderr
    return rows


def of(rows: Sequence[Finding], subject: str) -> Finding:
    """The first line about `subject` that is not ok, else the first one about it."""
    about = [row for row in rows if row.subject == subject]
    assert about, rows
    return next((row for row in about if row.level != "ok"), about[0])


def planted(root: Path, files: Mapping[str, str]) -> Path:
    """`root` with these files in it, by absolute path on the machine; returns `root`."""
    for name, content in files.items():
        file = root / name.lstrip("/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(content)
    return root


def first_on_path(folder: Path) -> dict[str, str]:
    """Environment of a process that imports from `folder` first."""
    return {"PYTHONPATH": f"{folder}{os.pathsep}{REPOSITORY}"}
