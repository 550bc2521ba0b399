"""The detector's whole life, as `demo` drives it: every transition, live changes, a model swap."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping
from types import MappingProxyType

from yolov5_lifecycle.doctor.finding import Check, Finding, Machine, error, ok
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.child_process import entry_point
from yolov5_lifecycle.unfinished import temporary_folder


def _life(_: Machine) -> Iterator[Finding]:
    output = ""
    with (
        temporary_folder() as folder,  # the demonstration writes below the current one
        subprocess.Popen(
            [entry_point("demo")], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as demo,
    ):
        assert demo.stdout is not None
        for line in demo.stdout:
            sys.stderr.write(line)  # `doctor` quotes the last ones if no further one follows in time
            output += line
    if demo.returncode == 0:
        found = output.rpartition("demo ok: ")[2].partition(", image")[0]
        yield ok(
            f"configured, activated, changed, model swapped, deactivated, activated again, shut down: {found}"
        )
    else:
        yield error(
            in_one_line(output.rpartition("demo failed: ")[2], 800),
            remedy="Correct the errors above first; then run `demo`, which shows every step, and report "
            "its output.",
        )


CHECKS: Mapping[str, Check] = MappingProxyType({"node": _life})
