"""Camera, detector and console, to watch them in a browser."""

from __future__ import annotations

import re
import signal
import time
from collections.abc import Callable, Mapping, Sequence

from yolov5_lifecycle.ros.demo.child_process import ProcessError, entry_point
from yolov5_lifecycle.ros.demo.domain import own_domain
from yolov5_lifecycle.ros.demo.processes import started

_CONSOLE = "console"
_ADDRESS = re.compile(r"console: (http\S+)")
_START_S = 60.0
_CHECK_S = 0.5


def show_live(commands: Mapping[str, Sequence[str]], *, port: int, report: Callable[[str], None]) -> None:
    """Run `commands`, by the names of their processes, and the console until Ctrl-C.

    Raises ProcessError if a process ends before that or does not end with exit code 0.
    """
    console = [entry_point(_CONSOLE), "--port", str(port)]
    with own_domain() as domain, started({**commands, _CONSOLE: console}, domain) as processes:
        shown = processes[-1]
        shown.wait_for_output("console: http", _START_S)
        address = _ADDRESS.search(shown.output)
        report(f"open {address[1] if address else shown.output} in a browser; Ctrl-C stops everything")
        try:
            while True:
                for process in processes:
                    process.check_running()
                time.sleep(_CHECK_S)
        except KeyboardInterrupt:
            report("stopping all processes")
        for process in reversed(processes):
            if code := process.stop(signal.SIGINT):
                raise ProcessError(f"the {process.name} ended with exit code {code} instead of 0")
