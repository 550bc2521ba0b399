"""Commands and nodes whose standard streams are closed, full or read by nobody."""

from __future__ import annotations

import os
import signal
import subprocess
from contextlib import closing
from pathlib import Path

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
@pytest.mark.parametrize("closing_words", ["", "<&- >&- 2>&-"], ids=["read by nobody", "closed"])
def test_a_node_does_its_work_whatever_its_streams(ros_domain: int, closing_words: str) -> None:
    """As in `detector 2>&1 | head -1`: it configures, which is logged, and SIGHUP ends its process with 0."""
    command = ["sh", "-c", f'exec "$0" {closing_words}', entry_point("detector")]
    with (
        started(
            command, env=environment(ros_domain), stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        ) as process,
        closing(Observer("client", domain=ros_domain)) as observer,
    ):
        assert process.stdout is not None
        assert b"Traceback" not in process.stdout.readline()
        process.stdout.close()
        node = RemoteLifecycleNode(observer, NODE)
        node.wait_until_reachable()
        assert node.change_state("configure")
        assert node.state() == "inactive"
        process.send_signal(signal.SIGHUP)
        assert process.wait(60) == 0
