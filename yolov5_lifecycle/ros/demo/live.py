"""Camera, detector and console, to watch them in a browser."""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Callable, Iterable, Mapping, Sequence

from yolov5_lifecycle.ros.demo.child_process import ChildProcess, ProcessError, entry_point
from yolov5_lifecycle.ros.demo.domain import own_domain
from yolov5_lifecycle.ros.demo.processes import DETECTOR_PROCESS, started

_CONSOLE = "console"
_ADDRESS = re.compile(r"console: (http\S+)")
_START_S = 60.0
_CHECK_S = 0.5


def show_live(commands: Mapping[str, Sequence[str]], *, port: int, report: Callable[[str], None]) -> None:
    """Run `commands`, by the names of their processes, and the console until Ctrl-C.

    The detector may be shut down before that, as the page has a button for it. Raises ProcessError if another
    process ends before that, or any with an exit code other than 0.
    """
    console = [entry_point(_CONSOLE), "--port", str(port)]
    with own_domain() as domain, started({**commands, _CONSOLE: console}, domain) as processes:
        shown = processes[-1]
        shown.wait_for_output("console: http", _START_S)
        address = _ADDRESS.search(shown.output)
        report(f"for ros2 commands in another terminal: export ROS_DOMAIN_ID={domain}")
        report(f"open {address[1] if address else shown.output} in a browser; Ctrl-C stops everything")
        running = list(processes)
        try:
            while True:
                running = _still_running(running, report)
                time.sleep(_CHECK_S)
        except KeyboardInterrupt:
            report("stopping all processes")
        for process in reversed(running):
            if code := process.stop(signal.SIGINT):
                raise ProcessError(f"the {process.name} ended with exit code {code} instead of 0")


def _still_running(processes: Iterable[ChildProcess], report: Callable[[str], None]) -> list[ChildProcess]:
    """`processes` without a detector that was shut down; raises ProcessError for any other that has ended."""
    running = []
    for process in processes:
        code = process.exit_code
        if code is None:
            running.append(process)
        elif process.name == DETECTOR_PROCESS and code == 0:
            report("the detector was shut down; to start it again: Ctrl-C, then the same command")
        else:
            process.check_running()
    return running
