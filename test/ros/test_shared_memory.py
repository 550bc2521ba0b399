"""A process says when there is too little shared memory for the middleware, and what helps."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
from pathlib import Path

import pytest
from support.colcon_workspace import REPOSITORY
from support.detector_process import environment

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.observer import PATIENCE_S
from yolov5_lifecycle.ros.shared_memory import PROCESS_BYTES, shared_memory_problems

FOLDER = Path("/shared")
PROFILE = REPOSITORY / "config" / "shm.xml"


def problems(free: int, **variables: str) -> list[str]:
    return shared_memory_problems(FOLDER, environment=variables, free=lambda _: free)


def test_too_little_memory_is_reported_with_the_need_and_the_remedy() -> None:
    free = PROCESS_BYTES - 1
    (problem,) = problems(free)
    assert problem.startswith(f"/shared has {free >> 10} KiB free and Fast DDS needs 656 KiB")
    assert all(remedy in problem for remedy in ("--shm-size", "--ipc=host", "fastdds shm clean"))
    assert problems(PROCESS_BYTES) == []


@pytest.mark.parametrize("variable", ["FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"])
def test_the_profile_for_images_needs_more_than_the_default_of_docker(variable: str) -> None:
    (problem,) = problems(64 << 20, **{variable: str(PROFILE)})
    assert "needs 69468 KiB" in problem
    assert problems(72 << 20, **{variable: str(PROFILE)}) == []


def test_an_unreadable_profile_is_ignored(tmp_path: Path) -> None:
    (tmp_path / "binary").write_bytes(bytes(range(256)) * 100)
    (tmp_path / "huge").write_text("<segment_size>" + "9" * 5000 + "</segment_size>")
    os.mkfifo(tmp_path / "pipe")
    for name in ("binary", "huge", "pipe", "absent", "", "\0"):
        assert problems(PROCESS_BYTES, FASTRTPS_DEFAULT_PROFILES_FILE=f"{tmp_path}/{name}") == []


@pytest.mark.parametrize(
    "variables",
    [{"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, {"FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}],
    ids=str,
)
def test_a_middleware_without_shared_memory_gets_no_warning(variables: dict[str, str]) -> None:
    assert problems(0, **variables) == []


def test_a_machine_without_such_a_folder_gets_no_warning() -> None:
    absent = Path("/nowhere/at/all")
    assert shared_memory_problems(absent, environment={}) == []


# Real processes whose /dev/shm is small


@pytest.fixture(scope="module")
def small() -> list[str]:
    """The words in front of a command that give it a /dev/shm of its own; the size is to be filled in."""
    if missing := [name for name in ("unshare", "mount") if shutil.which(name) is None]:
        pytest.skip(f"needs {', '.join(missing)} (util-linux)")
    command = [*("unshare", "--map-root-user", "--mount", "--fork", "--kill-child"), "sh", "-c"]
    refused = subprocess.run([*command, _mount("4k", ["true"])], capture_output=True, text=True)
    if refused.returncode != 0:
        pytest.skip(f"this machine allows no mount namespaces: {refused.stderr.strip()}")
    return command


def _mount(size: str, command: list[str]) -> str:
    return f"mount -t tmpfs -o size={size} tmpfs /dev/shm && exec {shlex.join(command)}"


@pytest.mark.long
def test_a_process_with_too_little_says_so_and_works(small: list[str], ros_domain: int) -> None:
    command = ["sh", "-c", f'echo "number $$"; exec {shlex.quote(entry_point("detector"))}']
    with ChildProcess("detector", [*small, _mount("300k", command)], environment(ros_domain)) as process:
        process.wait_for_output("KiB free", PATIENCE_S)
        process.wait_for_output("next step: ", PATIENCE_S)
        number = int(process.output.partition("number ")[2].split()[0])
        os.kill(number, signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    assert "and Fast DDS needs 656 KiB for this process" in process.output
