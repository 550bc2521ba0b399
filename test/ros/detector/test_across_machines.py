"""Camera and detector on two machines: two network namespaces with a cable between them."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from support.colcon_workspace import SUPPORT, SUPPORT_PATH
from support.detector_process import environment
from support.two_machines import ADDRESSES, DOMAIN

from yolov5_lifecycle.ros.child_process import ChildProcess

pytestmark = pytest.mark.long

PROGRAM = SUPPORT / "two_machines.py"
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
    command = [*ALONE, sys.executable, "-W", "ignore", str(PROGRAM)]
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
