"""Camera, detector and console together, until Ctrl-C."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest
from support.console_process import ConsoleClient
from support.detector_process import NODE, environment

from yolov5_lifecycle.ros.demo.child_process import ChildProcess, entry_point


@pytest.mark.long
def test_the_address_is_printed_and_all_processes_end(
    ros_domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    command = [entry_point("demo"), "--console", "--port", "0"]
    with ChildProcess("demo", command, environment(ros_domain)) as process:
        process.wait_for_output("in a browser", 120)
        found = re.search(r"http://\S+/", process.output)
        assert found
        with ConsoleClient(found[0]).page() as page, ConsoleClient(found[0]).page():
            page.wait_for_state("active", NODE)
        assert process.stop(signal.SIGINT) == 0, process.output
