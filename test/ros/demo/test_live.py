"""Camera, detector and console together, until Ctrl-C."""

from __future__ import annotations

import re
import signal
from contextlib import closing
from pathlib import Path

import pytest
from support.console_process import ConsoleClient
from support.detector_process import NODE, environment

from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.observer import Observer


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
        domain = re.search(r"export ROS_DOMAIN_ID=(\d+)\n", process.output)
        assert domain
        with ConsoleClient(found[0]).page() as page, ConsoleClient(found[0]).page():
            page.wait_for_state("active", NODE)
            with closing(Observer("client", domain=int(domain[1]))) as observer:
                names = observer.get_node_names
                observer.wait_for(lambda: NODE[1:] in names(), "the detector in the domain that was printed")
            assert page.transition("shutdown") == ""
            page.wait_for(lambda: NODE in page.gone, "its end")
            assert page.set(max_rate=3.0) == f"there is no detector {NODE}"
        assert process.stop(signal.SIGINT) == 0, process.output
        assert "failed" not in process.output
