"""Child processes, and a ROS domain that nobody else has."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from yolov5_lifecycle.ros import child_process
from yolov5_lifecycle.ros.child_process import ChildProcess, isolated, own_domain
from yolov5_lifecycle.ros.observer import PATIENCE_S


def test_a_claimed_domain_is_nobody_elses() -> None:
    with own_domain() as first:
        with own_domain() as second:
            assert second != first
        with own_domain() as third:
            assert third != first


def test_an_isolated_process_keeps_its_environment_but_reaches_only_its_domain() -> None:
    reaches = {"ROS_DOMAIN_ID": "0", "ROS_STATIC_PEERS": "robot", "ROS_LOCALHOST_ONLY": "1"}
    environment = {"HOME": "/home/me"} | reaches
    kept = {"HOME": "/home/me", "ROS_DOMAIN_ID": "7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    assert isolated(environment, 7) == kept


def test_a_process_that_ends_too_early_is_reported_with_its_last_words() -> None:
    program = "import sys; print('first'); sys.exit('out of coffee')"
    with ChildProcess("coffee machine", [sys.executable, "-c", program], os.environ) as process:
        assert process.wait(PATIENCE_S) == 1
        with pytest.raises(RuntimeError, match=r"coffee machine ended with exit code 1[^$]*out of coffee"):
            process.check_running()


def test_a_process_that_does_not_end_is_reported_and_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child_process, "_KILL_S", 0.1)
    ignore = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN)"
    program = f"{ignore}; print('ready', flush=True); time.sleep(60)"
    with ChildProcess("mule", [sys.executable, "-c", program], os.environ) as process:
        process.wait_for_output("ready", PATIENCE_S)
        with pytest.raises(RuntimeError, match=r"mule did not end within 0\.1 s"):
            process.stop(signal.SIGTERM, timeout_s=0.1)
    assert not Path(f"/proc/{process.process_id}").exists()
