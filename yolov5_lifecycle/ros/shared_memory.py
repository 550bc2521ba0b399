"""Check for enough free shared memory for Fast DDS."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

DEFAULT_RMW = "rmw_fastrtps_cpp"
"""ROS's middleware where RMW_IMPLEMENTATION is not set: Fast DDS."""
FOLDER = Path("/dev/shm")
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
PROCESS_BYTES = 656 << 10
"""Shared memory of a process: Fast DDS's default 512 KiB segment, two ports and their bookkeeping."""
_SEGMENT_FACTOR = 1.05  # size of a profile's segment including its bookkeeping
_MAX_PROFILE_BYTES = 1 << 20
_REMEDY = (
    "Give the container more (docker run --shm-size=1g, or --ipc=host), or remove the leftovers of dead "
    "processes: `fastdds shm clean`, or {folder}/fastrtps_* while no ROS process runs."
)


def free_bytes(folder: Path) -> int:
    """Free bytes in the file system of `folder`; raises OSError."""
    statistics = os.statvfs(folder)
    return statistics.f_bavail * statistics.f_frsize


def shared_memory_problems(
    folder: Path = FOLDER,
    *,
    environment: Mapping[str, str] = os.environ,
    free: Callable[[Path], int] = free_bytes,
) -> list[str]:
    """One line with the remedy if there is too little free shared memory for this process, else empty.

    Call it before rclpy is initialized, which allocates shared memory.
    """
    if not _is_taken(environment):
        return []
    needed = PROCESS_BYTES + int(_SEGMENT_FACTOR * _profile_segment_bytes(environment))
    try:
        found = free(folder)
    except OSError:  # no shared memory on this machine
        return []
    if found >= needed:
        return []
    return [
        f"{folder} has {found >> 10} KiB free and Fast DDS needs {needed >> 10} KiB for this process, "
        f"so Fast DDS uses only UDP, which loses large images. {_REMEDY.format(folder=folder)}"
    ]


def _is_taken(environment: Mapping[str, str]) -> bool:
    """Whether the middleware is Fast DDS (ROS's default) with shared memory (its default)."""
    middleware = environment.get("RMW_IMPLEMENTATION") or DEFAULT_RMW
    transports = environment.get("FASTDDS_BUILTIN_TRANSPORTS", "")
    return middleware.startswith("rmw_fastrtps") and not transports.startswith("UDP")


def _profile_segment_bytes(environment: Mapping[str, str]) -> int:
    """Max segment_size in the configured Fast DDS profiles, 0 without one."""
    sizes = [0]
    for variable in PROFILE_VARIABLES:
        path = Path(environment.get(variable, ""))
        try:
            if path.is_file():
                with path.open("rb") as file:
                    text = file.read(_MAX_PROFILE_BYTES)
                sizes += map(int, re.findall(rb"<segment_size>\s*(\d{1,12})\s*<", text))
        except (OSError, ValueError):  # Fast DDS reports it
            continue
    return max(sizes)
