"""How commands and nodes start: command line, version, and what a machine may lack."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.metadata import version

import pytest

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        pytest.param(["--help"], 0, ["confidence_threshold  ", "Default: 0.25"], id="help"),
        pytest.param(
            ["--device", "cpu", "--ros-args", "--params-file", "/nowhere.yaml"],
            2,
            ["not understood: --device cpu. Pass parameters as `detector --ros-args -p device:=VALUE`"],
            id="stray words",
        ),
        pytest.param(
            ["--ros-args", "-p", "use_sim_time:=1"], 2, ["'use_sim_time'"], id="a parameter of ROS's own"
        ),
    ],
)
def test_the_command_line_is_explained(words: list[str], code: int, told: list[str]) -> None:
    with ChildProcess("detector", [entry_point("detector"), *words], os.environ) as process:
        assert process.wait(60) == code
    assert all(word in process.output for word in told), process.output
    assert "Traceback" not in process.output


@pytest.mark.parametrize("command", ["detector", "doctor"])
def test_every_command_says_its_version(command: str) -> None:
    run = subprocess.run([entry_point(command), "--version"], capture_output=True, text=True, timeout=60)
    expected = f"{command} {version('yolov5_lifecycle')} (yolov5_lifecycle)\n"
    assert (run.returncode, run.stdout, run.stderr) == (0, expected, "")


@pytest.mark.parametrize("command", ["detector", "camera"])
def test_help_needs_no_place_for_a_log(command: str) -> None:
    nowhere = {name: value for name, value in os.environ.items() if name not in ("HOME", "ROS_LOG_DIR")}
    words = [entry_point(command), "--help"]
    run = subprocess.run(words, env=nowhere, capture_output=True, text=True, timeout=60)
    assert (run.returncode, run.stderr) == (0, "")
    assert "ros-args" in run.stdout


def test_too_few_threads_are_said_in_one_line() -> None:
    """As a user of its own: the limit counts all processes of a user, those of other workers' tests, too."""
    if os.geteuid() != 0 or (setpriv := shutil.which("setpriv")) is None:
        pytest.skip("needs setpriv (util-linux) and root, whom no limit holds otherwise")
    capabilities = "+dac_read_search,+dac_override"  # the environment may be root's own
    limited = f'ulimit -u 2 && exec "$0" {entry_point("detector")}'
    run = subprocess.run(
        [setpriv, "--reuid=54321", "--clear-groups", f"--inh-caps={capabilities}",
         f"--ambient-caps={capabilities}", "bash", "-c", limited, sys.executable],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert run.returncode == 1, run.stderr
    (line,) = run.stderr.splitlines()
    assert line.startswith("detector: ")
    assert "threads are needed, 1 can be started: raise the limit of processes (`ulimit -u`" in line
