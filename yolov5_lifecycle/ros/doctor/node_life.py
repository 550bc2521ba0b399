"""The detector's whole life, as `demo` drives it: every transition, live changes, a model swap."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping
from types import MappingProxyType

from yolov5_lifecycle.doctor.finding import Check, Finding, Machine, error, ok
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.demo.child_process import ProcessError
from yolov5_lifecycle.ros.demo.command import commands
from yolov5_lifecycle.ros.demo.demonstration import Demonstration
from yolov5_lifecycle.ros.demo.observer import NoAnswerError
from yolov5_lifecycle.ros.demo.outcome import DemonstrationError
from yolov5_lifecycle.ros.demo.processes import demonstrated
from yolov5_lifecycle.unfinished import temporary_folder


def _life(_: Machine) -> Iterator[Finding]:
    with temporary_folder() as folder:
        os.chdir(folder)  # the demonstration writes below the current folder
        try:
            found = demonstrated(
                commands(),
                lambda observer, detector: Demonstration(observer, detector, report=_step).run(),
                report=_step,
            )
        except (DemonstrationError, NoAnswerError, ProcessError) as problem:
            yield error(
                in_one_line(str(problem), 800),
                remedy="Correct the errors above first; then run `demo`, which shows every step, and report "
                "its output.",
            )
            return
        finally:
            os.chdir("/")
    first = found.phases[0]
    yield ok(
        "configured, activated, changed, model swapped, deactivated, activated again, shut down: "
        f"{first.recall:.0%} of the objects found, median latency {first.latencies_ms[0]:.0f} ms"
    )


def _step(text: str) -> None:
    """Show a step on stderr: `doctor` quotes the last ones if no further one follows in time."""
    sys.stderr.write(text + "\n")


CHECKS: Mapping[str, Check] = MappingProxyType({"node": _life})
