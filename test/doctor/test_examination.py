"""A check may crash, hang, fill its output and leave processes behind: the others are made all the same."""

from __future__ import annotations

import os
import re
import select
import textwrap
from dataclasses import replace
from pathlib import Path

import pytest

from yolov5_lifecycle.doctor.examination import Examination, examine
from yolov5_lifecycle.doctor.finding import ok

CHECKS = """
import os, signal, subprocess, sys, threading
from yolov5_lifecycle.doctor.finding import ok

def good(machine):
    yield ok(f"the target is {machine.target}")

def bad(machine):
    yield ok("begun")
%s

CHECKS = {"planted": {"first": good, "second": bad, "third": good}}
"""
ENDLESS_S = 3600.0
GOOD = ok("the target is camera")
BEGUN = replace(ok("begun"), subject="second camera")


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Examination:
    """An examination whose second check runs the parameter of the fixture."""
    (tmp_path / "planted_checks.py").write_text(CHECKS % textwrap.indent(request.param, "    "))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return Examination("planted", "planted_checks", ENDLESS_S, "do this", "camera")


@pytest.mark.long
@pytest.mark.parametrize(
    ("broken", "found"),
    [
        pytest.param("raise ValueError('no such thing')", "ValueError: no such thing", id="raises"),
        pytest.param("sys.exit('enough')", "SystemExit: enough", id="exits"),
        pytest.param("os._exit(0)", "it ended with exit code 0", id="ends"),
        pytest.param("os.abort()", "it ended with Aborted", id="aborts"),
        pytest.param(
            "sys.stderr.write('a\\nb\\nlast word\\n'); sys.stderr.flush(); os._exit(7)",
            "it ended with exit code 7. a | b | last word",
            id="says why",
        ),
        pytest.param(
            "sys.stderr.write('x' * (1 << 20)); sys.stderr.flush(); os._exit(7)",
            "it ended with exit code 7. " + "x" * 376 + "... (1048576 characters)",
            id="says too much",
        ),
        pytest.param(
            "print('out'); sys.stdout.flush(); os.write(1, b'[]\\n'); os._exit(7)",
            "it ended with exit code 7. out | []",
            id="writes to stdout",
        ),
    ],
    indirect=["broken"],
)
def test_a_check_that_ends_its_process_is_one_line(broken: Examination, found: str) -> None:
    first, begun, failed, third = examine(broken, root=Path("/"), patience_s=ENDLESS_S)
    assert [first, third] == [replace(GOOD, subject=f"{name} camera") for name in ("first", "third")]
    assert begun == BEGUN
    assert (failed.subject, failed.level, failed.found) == ("second camera", "error", found)
    assert failed.remedy


@pytest.mark.parametrize(
    "broken",
    [
        "child = subprocess.Popen(['sleep', '3600'])\n"
        "sys.stderr.write(f'pid {child.pid}\\n')\n"
        "threading.Event().wait()"
    ],
    indirect=True,
    ids=["waits"],
)
def test_a_check_that_hangs_is_killed_with_what_it_started(broken: Examination) -> None:
    *_, begun, hung = examine(broken, root=Path("/"), patience_s=2.9)
    assert begun == BEGUN
    assert hung.subject == "second camera"
    assert hung.found.startswith("no answer within 3 s")
    assert hung.remedy == "do this"
    (process_id,) = re.findall(r"pid (\d+)", hung.found)
    assert ends(int(process_id))


@pytest.mark.parametrize(
    "broken", ["subprocess.Popen(['sleep', '3600']); os._exit(7)"], indirect=True, ids=["orphan"]
)
def test_a_process_left_behind_keeps_nobody_waiting(broken: Examination) -> None:
    assert len(examine(broken, root=Path("/"), patience_s=ENDLESS_S)) == 4


def ends(process_id: int) -> bool:
    """Whether the process ends soon or has ended: SIGKILL takes effect at its next turn."""
    try:
        descriptor = os.pidfd_open(process_id)
    except ProcessLookupError:
        return True
    ready, _, _ = select.select([descriptor], [], [], 60.0)
    os.close(descriptor)
    return bool(ready)


@pytest.mark.parametrize(
    ("program", "found"),
    [
        pytest.param("import no_such_package", "ModuleNotFoundError: No module named", id="absent package"),
        pytest.param("raise SystemExit(1)", "SystemExit: 1", id="exits"),
        pytest.param("import os; os._exit(3)", "it ended with exit code 3", id="ends"),
    ],
)
def test_checks_that_cannot_be_imported_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, found: str
) -> None:
    (tmp_path / "planted_checks.py").write_text(program)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    examination = Examination("planted", "planted_checks", ENDLESS_S, "do this")
    (line,) = examine(examination, root=Path("/"), patience_s=ENDLESS_S)
    assert line.level == "error"
    assert line.found.startswith(found)


def test_modules_of_the_current_folder_are_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "platform.py").write_text("raise SystemExit('the wrong module')")
    monkeypatch.chdir(tmp_path)
    system = Examination("system", "yolov5_lifecycle.doctor.system", ENDLESS_S, "do this")
    assert "wrong module" not in str(examine(system, root=Path("/"), patience_s=ENDLESS_S))
