"""A process says when there is too little shared memory for the middleware, and what helps."""

from __future__ import annotations

import os
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


def test_a_middleware_or_machine_without_shared_memory_gets_no_warning() -> None:
    assert problems(0, RMW_IMPLEMENTATION="rmw_cyclonedds_cpp") == []
    assert problems(0, FASTDDS_BUILTIN_TRANSPORTS="UDPv4") == []
    assert shared_memory_problems(Path("/nowhere/at/all"), environment={}) == []


@pytest.mark.long
def test_a_process_with_too_little_says_so_and_works(ros_domain: int, tmp_path: Path) -> None:
    profile = tmp_path / "shm.xml"
    profile.write_text("<segment_size>999999999999</segment_size>")  # which Fast DDS itself refuses
    variables = environment(ros_domain) | {"FASTRTPS_DEFAULT_PROFILES_FILE": str(profile)}
    with ChildProcess("detector", [entry_point("detector")], variables) as process:
        process.wait_for_output("KiB for this process, so Fast DDS uses only UDP", PATIENCE_S)
        process.wait_for_output("next step: ", PATIENCE_S)
        assert process.stop() == 0
