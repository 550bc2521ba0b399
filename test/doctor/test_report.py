"""The report as text and JSON, its exit code, its time and its arguments."""

from __future__ import annotations

import getpass
import itertools
import os
import select
import signal
import socket
import subprocess
from pathlib import Path

import pytest
from support.doctor_process import command, doctor

from yolov5_lifecycle.doctor.command import main
from yolov5_lifecycle.doctor.examination import NAMES, TIME_S, planned
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point


def test_the_report_ends_with_a_summary_and_says_the_remedy_below_the_line(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file where a folder should be")
    run = subprocess.run(
        [entry_point("doctor"), "--only", "system"],
        env=os.environ | {"XDG_CACHE_HOME": f"{tmp_path}/cache"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (run.returncode, run.stderr) == (0, "")
    first, *lines, last = run.stdout.splitlines()
    assert first.startswith("doctor ")
    assert first.endswith("takes at most 120 s")
    (number,) = [number for number, line in enumerate(lines) if line.startswith("warning  cache")]
    assert lines[number + 1].startswith("         -> Give this user the right")
    assert ", 1 warnings, 0 errors in " in last


def test_what_the_time_does_not_reach_is_an_error_that_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    hours_s = itertools.count(step=3600.0)
    assert main(["--only", "system", "--time", "10"], now_s=lambda: next(hours_s)) == 1
    assert "error    system" in (told := capsys.readouterr().out)
    assert "not examined, because the 10 s are over" in told
    assert "`doctor --only system`" in told


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--time", "5"], "--time: expected 10 to 3600 seconds, found 5"),
        (["--time", "nan"], "--time: expected 10 to 3600 seconds, found nan"),
        (["--only", "everything"], "invalid choice: 'everything'"),
        (["now"], "unrecognized arguments: now"),
    ],
    ids=["short", "no number", "unknown", "stray"],
)
def test_wrong_arguments_are_explained(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert told in capsys.readouterr().err


def test_every_examination_can_be_asked_for_and_has_a_patience(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    for number in range(20):
        (tmp_path / "dev" / f"video{number}").touch()
    examinations = planned(tmp_path)
    assert {each.name for each in examinations} == set(NAMES)
    assert all(0 < each.patience_s < TIME_S for each in examinations)
    assert [each.target for each in examinations if each.name == "camera"] == [
        f"/dev/video{number}" for number in range(8)
    ]


def test_the_end_of_the_doctor_ends_its_checks(tmp_path: Path) -> None:
    (tmp_path / "dev").mkdir()
    os.mkfifo(camera := tmp_path / "dev" / "video0")
    with ChildProcess(
        "doctor", command("--only", "camera", "--time", "3600", root=tmp_path), os.environ
    ) as process:
        sending = os.open(camera, os.O_WRONLY)  # waits until the check has opened it
        assert process.stop(signal.SIGTERM) == 143
        poll = select.poll()
        poll.register(sending, 0)  # an error without a reader
        assert poll.poll(60_000) == [(sending, select.POLLERR)]
        os.close(sending)


@pytest.mark.end_to_end
def test_this_machine_passes_and_the_report_is_public() -> None:
    rows = doctor("--time", "600", environment={"USER": "ada-lovelace"})
    subjects = dict.fromkeys(row.subject for row in rows)
    assert [row for row in rows if row.level == "error"] == []
    assert {"system", "packages", "ROS", "forward", "runtime openvino", "image transport", "node"} <= set(
        subjects
    )
    private = {socket.gethostname(), "ada-lovelace", getpass.getuser()} - {"root", "localhost"}
    assert [name for name in private if name in str(rows)] == []
