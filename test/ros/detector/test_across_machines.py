"""Camera and detector on two machines: two network namespaces with a cable that is pulled.

This file is also the program that runs alone in its namespaces, with the rights of root there, which
`unshare --map-root-user --net --mount` gives to anybody. The environment says how the two find each other.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from xml.etree import ElementTree

import pytest
from support.colcon_workspace import SUPPORT, SUPPORT_PATH
from support.detector_process import (
    NODE,
    PARAMETERS,
    SEED,
    DetectorProcess,
    as_arguments,
    environment,
    is_balanced,
)
from support.started import started

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.observer import Observer

pytestmark = pytest.mark.long

CABLE = "cable"
ADDRESSES = ("10.77.0.1", "10.77.0.2")
DOMAIN = 1  # nobody else is in this network
PATIENCE_S = 120.0  # a busy machine takes its time
LEASE = SUPPORT / "short_lease.xml"
LEASE_S = float(ElementTree.parse(LEASE).findtext(".//{*}leaseDuration/{*}sec", ""))
CAMERA_PARAMETERS = {
    "width": 320,
    "height": 240,
    "seed": SEED,
    "rate": 5.0,
}  # a busy machine loses none of them
DETECTOR_PARAMETERS = PARAMETERS | {"runtime": "torch"}  # `auto` would first measure them all

Machine = list[str]
"""The words in front of a command that let it run there."""
HERE: Machine = []


def run(machine: Machine, command: str) -> str:
    """What the command says; raises CalledProcessError."""
    return subprocess.run([*machine, *command.split()], check=True, stdout=subprocess.PIPE, text=True).stdout


@contextmanager
def machine_beyond_a_cable() -> Iterator[Machine]:
    """Namespaces beside those of this process, as long as the block."""
    command = ["unshare", "--net", "--mount", "sh", "-c", "echo there && exec cat"]
    with started(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "there\n"
        there = ["nsenter", f"--target={holder.pid}", "--net", "--mount"]
        run(HERE, f"ip link add {CABLE} type veth peer name {CABLE} netns {holder.pid}")
        for machine, address in ((HERE, ADDRESSES[0]), (there, ADDRESSES[1])):
            run(machine, "mount -t tmpfs none /dev/shm")  # nothing but the cable may carry images
            run(machine, "ip link set lo up")
            run(machine, f"ip address add {address}/24 dev {CABLE}")
            run(machine, f"ip link set {CABLE} up")
        # Fast DDS never uses an interface that did not run when the process started.
        while not all("state UP" in run(machine, f"ip link show {CABLE}") for machine in (HERE, there)):
            pass
        yield there


@contextmanager
def camera_and_detector(there: Machine) -> Iterator[DetectorProcess]:
    """A camera there and the detector here, which soon forget each other.

    Both, because Fast DDS may never match them again if one was forgotten and the other was not:
    https://github.com/eProsima/Fast-DDS/issues/155
    """
    remap = ["--ros-args", "-r", f"image_raw:={NODE}/image_raw"]
    camera_command = [*there, entry_point("camera"), *remap, *as_arguments(CAMERA_PARAMETERS)]
    detector_command = [entry_point("detector"), "--ros-args", *as_arguments(DETECTOR_PARAMETERS)]
    variables = os.environ | {"FASTRTPS_DEFAULT_PROFILES_FILE": str(LEASE)}
    with (
        ChildProcess("camera", camera_command, variables) as camera,
        ChildProcess("detector", detector_command, variables) as process,
    ):
        process.wait_for_output("unconfigured", PATIENCE_S)
        with closing(Observer("client", domain=DOMAIN, check=process.check_running)) as observer:
            yield DetectorProcess(process, observer, DOMAIN)
        assert [each.stop(signal.SIGINT, timeout_s=PATIENCE_S) for each in (camera, process)] == [0, 0]


def wait_for_frames(detector: DetectorProcess, number: int) -> None:
    """Wait for the detections of so many images that are yet to come."""
    wanted = len(detector.detections) + number
    detector.observer.wait_for(
        lambda: len(detector.detections) >= wanted, f"detections of {number} images", timeout_s=PATIENCE_S
    )


def status_that_tells(detector: DetectorProcess, text: str) -> dict[str, str]:
    """The next diagnostics with `text` in their message; their frame balance is exact."""
    seen: list[dict[str, str]] = []

    def is_told() -> bool:
        seen.append(detector.status())
        assert is_balanced(seen[-1]), seen[-1]
        return text in seen[-1]["message"]

    detector.observer.wait_for(is_told, f"diagnostics that tell '{text}'", timeout_s=PATIENCE_S)
    return seen[-1]


def main() -> None:
    with machine_beyond_a_cable() as there, camera_and_detector(there) as detector:
        detector.bring_to("active")
        wait_for_frames(detector, 5)
        status_that_tells(detector, "detecting")
        run(HERE, f"ip link set {CABLE} down")
        status_that_tells(detector, "although the topic has a publisher")
        cut_off = status_that_tells(detector, "no publisher of images on /yolov5/image_raw")
        detector.observer.work_for(LEASE_S)  # by then the camera has forgotten the detector, too
        run(HERE, f"ip link set {CABLE} up")
        wait_for_frames(detector, 5)
        restored = status_that_tells(detector, "detecting")
        assert int(restored["frames detected"]) >= int(cut_off["frames detected"]) + 5, restored


ALONE = ["unshare", "--map-root-user", "--net", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc"]
WAYS = {
    "multicast": {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"},
    "peers": {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_STATIC_PEERS": ";".join(ADDRESSES)},
}


@pytest.fixture(scope="module")
def trials() -> Iterator[dict[str, ChildProcess]]:
    """One for each way to find each other, all at once: most of the time they wait."""
    if missing := [name for name in ("unshare", "nsenter", "ip", "mount") if shutil.which(name) is None]:
        pytest.skip(f"needs {', '.join(missing)} (util-linux, iproute2)")
    trial = [*ALONE, "sh", "-c", "mount -t tmpfs none /dev/shm && ip link add cable type veth"]
    refused = subprocess.run(trial, capture_output=True, text=True)
    if refused.returncode != 0:
        pytest.skip(f"this machine allows no network namespaces: {refused.stderr.strip()}")
    command = [*ALONE, sys.executable, "-W", "ignore", __file__]
    with ExitStack() as stack:
        yield {
            way: stack.enter_context(
                ChildProcess(way, command, environment(DOMAIN) | SUPPORT_PATH | variables)
            )
            for way, variables in WAYS.items()
        }


@pytest.mark.timeout(600)
@pytest.mark.parametrize("way", WAYS)
def test_a_detector_that_was_cut_off_reports_it_and_recovers(
    trials: dict[str, ChildProcess], way: str
) -> None:
    code = trials[way].wait(timeout_s=600)
    assert code == 0, trials[way].output


if __name__ == "__main__":
    main()
