"""The report: lines, exit code, time and arguments; a check may crash, hang and leave processes behind."""

from __future__ import annotations

import getpass
import itertools
import os
import re
import select
import signal
import socket
import subprocess
import textwrap
from pathlib import Path

import pytest
from support.doctor_process import command, doctor, first_on_path, planted

from yolov5_lifecycle.doctor.command import NAMES, TIME_S, Examination, examine, main, planned
from yolov5_lifecycle.doctor.finding import Finding, public, warning, without_private_names
from yolov5_lifecycle.ros.child_process import ChildProcess

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
FIRST = Finding("first camera", "ok", "the target is camera", "")
BEGUN = Finding("second camera", "ok", "begun", "")


@pytest.fixture
def broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Examination:
    """An examination whose second check runs the parameter of the fixture."""
    (tmp_path / "planted_checks.py").write_text(CHECKS % textwrap.indent(request.param, "    "))
    monkeypatch.setenv("PYTHONPATH", first_on_path(tmp_path)["PYTHONPATH"])
    return Examination("planted", "planted_checks", ENDLESS_S, "do this", "camera")


@pytest.mark.parametrize(
    ("broken", "end"),
    [
        pytest.param("subprocess.Popen(['sleep', '3600']); os.abort()", "Aborted", id="leaves a process"),
        pytest.param(
            "print('out'); sys.stdout.flush(); os.write(1, b'[]\\n'); os._exit(7)", "exit code 7", id="stdout"
        ),
        pytest.param(
            "sys.stderr.write('x' * (1 << 20)); sys.stderr.flush(); os._exit(0)", "exit code 0", id="long"
        ),
        pytest.param("sys.exit('enough')", "exit code 1", id="exits"),
        pytest.param("raise RuntimeError('enough')", "exit code 1", id="raises"),
    ],
    indirect=["broken"],
)
def test_a_check_that_ends_its_process_is_told_with_its_last_words(broken: Examination, end: str) -> None:
    first, begun, failed = examine(broken, root=Path("/"), patience_s=ENDLESS_S)
    assert (first, begun) == (FIRST, BEGUN)
    said, _, words = failed.found.partition(". ")
    assert said == f"it ended with {end}; what follows in this group was not checked"
    told = ("", "out | []", "SystemExit: enough", "RuntimeError: enough")
    assert words in told or words.endswith("... (1048576 characters)")
    assert (failed.subject, failed.remedy) == ("second camera", "do this")


HANGS = """child = subprocess.Popen(['sleep', '3600'])
sys.stderr.write(f'pid {child.pid}\\n')
threading.Event().wait()"""


@pytest.mark.parametrize("broken", [HANGS], indirect=True, ids=["waits"])
def test_a_check_that_hangs_is_killed_with_what_it_started(broken: Examination) -> None:
    *_, begun, hung = examine(broken, root=Path("/"), patience_s=1.9)
    assert begun == BEGUN
    assert hung.subject == "second camera"
    assert hung.found.startswith("no answer within 2 s; what follows in this group was not checked. pid ")
    assert hung.remedy == "do this"
    (process_id,) = re.findall(r"pid (\d+)", hung.found)
    assert ends(int(process_id))


def ends(process_id: int) -> bool:
    """Whether the process ends soon or has ended: SIGKILL takes effect at its next turn."""
    try:
        descriptor = os.pidfd_open(process_id)
    except ProcessLookupError:
        return True
    ready, _, _ = select.select([descriptor], [], [], 60.0)
    os.close(descriptor)
    return bool(ready)


def test_modules_of_the_current_folder_are_not_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "platform.py").write_text("raise SystemExit('the wrong module')")
    monkeypatch.chdir(tmp_path)
    system = Examination("system", "yolov5_lifecycle.doctor.system", ENDLESS_S, "do this")
    assert "wrong module" not in str(examine(system, root=Path("/"), patience_s=ENDLESS_S))


def test_the_report_ends_with_a_summary_and_says_the_remedy_below_the_line(tmp_path: Path) -> None:
    root = planted(tmp_path, {"/proc/meminfo": "MemAvailable: 1048576 kB\n"})
    run = subprocess.run(command("--only", "system", root=root), capture_output=True, text=True, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    first, *lines, last = run.stdout.splitlines()
    assert first.startswith("doctor ")
    assert first.endswith("takes at most 120 s")
    (number,) = [number for number, line in enumerate(lines) if line.startswith("warning  memory")]
    assert lines[number].endswith(" 1.0 GiB is available")
    assert lines[number + 1].startswith("         -> End other programs or raise the limit")
    assert ", 1 warnings, 0 errors in " in last


def test_what_the_time_does_not_reach_is_an_error_that_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    hours_s = itertools.count(step=3600.0)
    assert main(["--only", "system", "--time", "10"], now_s=lambda: next(hours_s)) == 1
    assert "error    system" in (told := capsys.readouterr().out)
    assert "not examined, because the 10 s are over" in told
    assert "`doctor --only system`" in told


@pytest.mark.parametrize("seconds", ["5", "nan"])
def test_a_time_that_no_check_can_keep_is_refused(seconds: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["--time", seconds])
    assert f"--time: expected 10 to 3600 seconds, found {seconds}" in capsys.readouterr().err


def test_every_examination_can_be_asked_for_and_has_a_patience(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    for number in range(20):
        (tmp_path / "dev" / f"video{number}").touch()
    examinations = planned(tmp_path)
    assert {each.name for each in examinations} == set(NAMES)
    assert all(0 < each.patience_s < TIME_S for each in examinations)
    cameras = [each.target for each in examinations if each.name == "camera"]
    assert cameras == [f"/dev/video{number}" for number in range(8)]


def test_the_end_of_the_doctor_ends_its_checks(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    os.mkfifo(camera := tmp_path / "dev" / "video0")
    words = command("--only", "camera", "--time", "3600", root=tmp_path)
    with ChildProcess("doctor", words, os.environ) as process:
        sending = os.open(camera, os.O_WRONLY)  # waits until the check has opened it
        assert process.stop(signal.SIGTERM) == 143
        poll = select.poll()
        poll.register(sending, 0)  # an error without a reader
        assert poll.poll(60_000) == [(sending, select.POLLERR)]
        os.close(sending)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/home/ada/.cache is full", "~/.cache is full"),
        ("/home/adam/x", "/home/(user)/x"),
        ("/Users/eve/y", "/Users/(user)/y"),
        ("/data/ada/models", "/data/(user)/models"),
        ("ada@walle.lab.example: no route to walle", "(user)@(host): no route to (host)"),
        ("adaptive walleye in canada", "adaptive walleye in canada"),
        ("aa:bb:cc:dd:ee:ff at 192.168.1.20", "(address) at (address)"),
        ("GPU-1f2e3d4c-0a1b-2c3d-4e5f-60718293a4b5 lost", "(serial) lost"),
        ("/dev/v4l/by-id/usb-046d_C920_5A2B-index0 is busy", "/dev/(serial) is busy"),
        ("10.0.0.7 and 172.20.1.2 and 127.0.0.1", "(address) and (address) and (address)"),
        ("OpenCV 4.10.0.84, driver 550.54.15", "OpenCV 4.10.0.84, driver 550.54.15"),
    ],
)
def test_private_names_are_replaced(text: str, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "walle.lab.example")
    monkeypatch.setenv("HOME", "/home/ada")
    monkeypatch.setenv("USER", "ada")
    assert without_private_names(text) == expected
    line = public(warning(f"{text}\x1b[31m", remedy="ask ada\nor wait"))
    assert line == warning(f"{expected}?[31m", remedy="ask (user) or wait")


def test_names_that_everybody_has_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "ubuntu")
    monkeypatch.setenv("HOME", "/")
    monkeypatch.setenv("USER", "ros")
    text = "root in /opt/ros on ubuntu"
    assert without_private_names(text) == text


@pytest.mark.end_to_end
def test_this_machine_passes_and_the_report_is_public() -> None:
    rows = doctor("--time", "600", environment={"USER": "ada-lovelace"})
    assert [row for row in rows if row.level == "error"] == []
    subjects = {"system", "packages", "ROS", "forward", "runtime openvino", "image transport", "node"}
    assert subjects <= {row.subject for row in rows}
    private = {socket.gethostname(), "ada-lovelace", getpass.getuser()} - {"root", "localhost"}
    assert [name for name in private if name in str(rows)] == []
