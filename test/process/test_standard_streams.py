"""Commands and nodes whose standard streams are closed, full or read by nobody."""

from __future__ import annotations

import os
import signal
import subprocess
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from support.detector_process import NODE, environment
from support.started import started

from yolov5_lifecycle.ros.child_process import entry_point
from yolov5_lifecycle.ros.observer import Observer, RemoteLifecycleNode


@pytest.mark.long
@pytest.mark.parametrize(("command", "is_buffered"), [("convert", True), ("camera", False)])
def test_an_output_that_cannot_be_written_is_said_in_one_line(command: str, is_buffered: bool) -> None:
    variables = os.environ | {"PYTHONUNBUFFERED": "" if is_buffered else "1"}
    with Path("/dev/full").open("w") as full:
        run = subprocess.run(
            [entry_point(command), "--help"],
            env=variables,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
        )
    reason = f"{command}: the output cannot be written: No space left on device\n"
    assert (run.returncode, run.stderr) == (1, reason)


@pytest.mark.long
@pytest.mark.parametrize("command", ["fetch_weights", "detector"])
def test_a_closed_pipe_ends_the_command_silently(command: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    run = subprocess.run(
        [entry_point(command), "--help"],
        env=os.environ | {"PYTHONUNBUFFERED": ""},  # argparse ignores an error while it writes the help
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
    )
    os.close(writing)
    assert (run.returncode, run.stderr) == (141, "")


@pytest.mark.long
def test_a_node_goes_on_when_nobody_reads_its_log(ros_domain: int) -> None:
    """As in `detector 2>&1 | head -1`."""
    with started(
        [entry_point("detector")],
        env=environment(ros_domain),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()
        still_served_then_ended(process, ros_domain)


@pytest.mark.long
def test_a_node_does_its_work_with_closed_streams(ros_domain: int) -> None:
    command = ["sh", "-c", 'exec "$0" <&- >&- 2>&-', entry_point("detector")]
    with started(
        command, env=environment(ros_domain), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    ) as process:
        still_served_then_ended(process, ros_domain)
        assert process.stdout is not None
        assert "Traceback" not in process.stdout.read()


def still_served_then_ended(process: subprocess.Popen[Any], domain: int) -> None:
    """The node configures, which is logged, and SIGHUP ends its process with 0."""
    with closing(Observer("client", domain=domain)) as observer:
        node = RemoteLifecycleNode(observer, NODE)
        node.wait_until_reachable()
        assert node.change_state("configure")
        assert node.state() == "inactive"
    process.send_signal(signal.SIGHUP)
    assert process.wait(60) == 0
