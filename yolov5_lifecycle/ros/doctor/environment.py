"""ROS as this terminal sees it: distribution, middleware, discovery, shared memory."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from yolov5_lifecycle.doctor.finding import Finding, Groups, Machine, error, ok, warning
from yolov5_lifecycle.input_file import resolve_package
from yolov5_lifecycle.process.missing_package import apt_package_of
from yolov5_lifecycle.ros.shared_memory import (
    DEFAULT_RMW,
    PROFILE_VARIABLES,
    free_bytes,
    shared_memory_problems,
)

PROFILE = "package://yolov5_lifecycle/config/shm.xml"
_DISTRIBUTIONS = {"7": "jazzy", "9": "kilted"}
"""By the first number of rclpy's version."""
_RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
_LAST_DOMAIN = 232


def _distribution(_: Machine) -> Iterator[Finding]:
    """Raises what the import of missing or broken messages raises."""
    for module in (
        "rclpy",
        "sensor_msgs.msg",
        "diagnostic_msgs.msg",
        "lifecycle_msgs.srv",
        "vision_msgs.msg",
    ):
        import_module(module)
    rclpy = version("rclpy")
    known = _DISTRIBUTIONS.get(rclpy.partition(".")[0], "")
    sourced = os.environ.get("ROS_DISTRO", known)
    found = f"ROS 2 {known or sourced}, rclpy {rclpy}"
    if not known:
        yield warning(
            found, remedy="Use ROS 2 Jazzy or Kilted: nobody has tried this package with another rclpy."
        )
    elif sourced != known:
        yield error(
            f"{found}, but ROS_DISTRO is {sourced}",
            remedy="Use a terminal in which one ROS is sourced, or in which .venv is active, but not both.",
        )
    else:
        yield ok(found)


def _middleware(_: Machine) -> Iterator[Finding]:
    name = os.environ.get("RMW_IMPLEMENTATION") or DEFAULT_RMW
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    folders = (Path(prefix, "share/ament_index/resource_index/rmw_typesupport") for prefix in prefixes)
    installed = sorted({file.name for folder in folders for file in folder.glob("rmw_*_cpp")})
    if name not in installed:
        yield error(
            f"RMW_IMPLEMENTATION is {name}, installed are {', '.join(installed) or 'none'}",
            remedy=f"`export RMW_IMPLEMENTATION={next(iter(installed), DEFAULT_RMW)}`, or install the other "
            f"one with `sudo apt install {apt_package_of(name)}`.",
        )
    else:
        yield ok(f"{name}; installed are {', '.join(installed)}")
    for variable in (*PROFILE_VARIABLES, "CYCLONEDDS_URI"):
        path = os.environ.get(variable, "").removeprefix("file://")
        # Cyclone DDS takes the text itself, too.
        if path and not path.lstrip().startswith("<") and not Path(path).is_file():
            yield error(
                f"{variable} is {path}, which is no file",
                remedy=f"Correct the path, or `unset {variable}`: its settings do not apply.",
            )
    if (transports := os.environ.get("FASTDDS_BUILTIN_TRANSPORTS", "")).startswith("UDP"):
        yield warning(
            f"FASTDDS_BUILTIN_TRANSPORTS is {transports}: images go over UDP, which loses large ones, even "
            "on this machine",
            remedy="`unset FASTDDS_BUILTIN_TRANSPORTS`, unless all images leave this machine.",
        )


def _discovery(_: Machine) -> Iterator[Finding]:
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"
    problems = list(_discovery_problems(domain, reach))
    yield from problems or [ok(f"domain {domain}, discovery range {reach}")]


def _discovery_problems(domain: str, reach: str) -> Iterator[Finding]:
    number = int(domain) if domain.isdecimal() and len(domain) < 9 else -1
    if not 0 <= number <= _LAST_DOMAIN:
        yield error(
            f"ROS_DOMAIN_ID is {domain}: no node can start",
            remedy="`export ROS_DOMAIN_ID=` a number from 0 to 101, the same for all nodes.",
        )
    if reach not in _RANGES:
        yield error(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE is {reach}, which means LOCALHOST to ROS",
            remedy=f"`export ROS_AUTOMATIC_DISCOVERY_RANGE=` one of {', '.join(_RANGES)}.",
        )
    elif reach == "OFF":
        yield warning(
            "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF: nodes do not find each other, even on this machine",
            remedy="`unset ROS_AUTOMATIC_DISCOVERY_RANGE`, unless ROS_STATIC_PEERS names all machines.",
        )
    if os.environ.get("ROS_LOCALHOST_ONLY", "0") == "1":
        yield warning(
            "ROS_LOCALHOST_ONLY is set, which is out of date and overrides the discovery range",
            remedy="`unset ROS_LOCALHOST_ONLY`, and `export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST` "
            "instead.",
        )


def _shared_memory(machine: Machine) -> Iterator[Finding]:
    folder = machine.path("/dev/shm")
    if not folder.is_dir():
        yield warning(
            "/dev/shm does not exist, so images go over UDP, which loses large ones",
            remedy="Mount it with `sudo mount -t tmpfs tmpfs /dev/shm`, or start the container with "
            "--ipc=host.",
        )
        return
    with_profile = {PROFILE_VARIABLES[0]: resolve_package(PROFILE)}
    for problem in shared_memory_problems(folder) or shared_memory_problems(folder, environment=with_profile):
        found, _, remedy = problem.partition(". ")
        yield warning(found, remedy=remedy)
        return
    yield ok(f"{free_bytes(folder) >> 20} MiB free in /dev/shm")


CHECKS: Groups = {
    "ros": {
        "middleware": _middleware,
        "discovery": _discovery,
        "shared memory": _shared_memory,
        "ROS": _distribution,  # last: with a wrong middleware, importing rclpy ends the process
    }
}
