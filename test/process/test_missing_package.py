"""A missing package is reported with the command that installs it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from yolov5_lifecycle.commands.entry_points import MODULES
from yolov5_lifecycle.process.missing_package import apt_package_of, import_problem


@pytest.mark.parametrize(
    ("error", "remedy"),
    [
        pytest.param(
            ModuleNotFoundError("No module named 'torch'", name="torch"),
            f"Install it with {sys.executable} -m pip install torch",
            id="from pip",
        ),
        pytest.param(
            ModuleNotFoundError("No module named 'cv2'", name="cv2"),
            "opencv-python-headless, or for a ROS from apt with sudo apt install python3-opencv",
            id="from apt or pip",
        ),
        pytest.param(
            ModuleNotFoundError("No module named 'rclpy'", name="rclpy"), "source ROS first", id="ROS"
        ),
        pytest.param(
            ImportError("libGL.so.1: cannot open shared object file", name="cv2"),
            "lacks a system library",
            id="installed, but broken",
        ),
    ],
)
def test_the_remedy_fits_what_is_missing(error: ImportError, remedy: str) -> None:
    problem = import_problem(error)
    assert problem.startswith(f"{sys.executable} cannot import what is needed: {error}. ")
    assert remedy in problem
    assert problem.isprintable()


def test_a_remedy_has_the_python_and_the_distribution_of_this_environment(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "executable", "/my venv/bin/python")
    problem = import_problem(ModuleNotFoundError("No module named 'torch'", name="torch"))
    assert "Install it with '/my venv/bin/python' -m pip install torch" in problem
    monkeypatch.setenv("ROS_DISTRO", "kilted")
    assert "source /opt/ros/kilted/setup.bash" in import_problem(ModuleNotFoundError("no", name="rclpy"))
    assert apt_package_of("nav2_msgs") == "ros-kilted-nav2-msgs"


def run_without(
    modules: tuple[str, ...], command: str, *words: str, where: str = "commands"
) -> subprocess.CompletedProcess[str]:
    """`command` with the arguments `words`, in a process that cannot import `modules`."""
    program = (
        f"import sys; sys.modules.update(dict.fromkeys({modules!r})); "
        f"from yolov5_lifecycle.{where}.entry_points import {command}; {command}()"
    )
    arguments = [sys.executable, "-c", program, *words]
    return subprocess.run(arguments, capture_output=True, text=True, check=False)


@pytest.mark.long
@pytest.mark.parametrize("command", sorted(MODULES.keys() - {"demo", "doctor"}))
def test_a_command_shows_its_help_without_the_libraries_that_it_needs(command: str) -> None:
    run = run_without(("cv2", "rosbags", "torch"), command, "--help")
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.startswith(f"usage: {command} ")


@pytest.mark.long
@pytest.mark.parametrize(
    ("where", "command", "package"),
    [
        ("commands", "convert", "torch"),
        ("commands", "detect_bag", "cv2"),
        ("ros", "detector", "torch"),
        ("ros", "detector", "rclpy"),
        ("ros", "camera", "cv2"),
    ],
)
def test_a_command_or_node_that_lacks_a_package_ends_with_one_line(
    where: str, command: str, package: str
) -> None:
    run = run_without((package,), command, "a.pt", "b.safetensors", where=where)
    assert (run.returncode, run.stdout) == (1, "")
    (line,) = run.stderr.splitlines()
    assert line.startswith(f"{command}: {sys.executable} cannot import what is needed")
    assert package in line.partition(". The node")[0]
