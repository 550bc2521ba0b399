"""The installed `camera` as a process of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from support.detector_process import environment
from yolov5_lifecycle.ros.child_process import ChildProcess, entry_point

END_S = 60.0
"""How long its end is waited for."""


@contextmanager
def camera_process(domain: int, *arguments: str) -> Iterator[ChildProcess]:
    command = [entry_point("camera"), *arguments]
    with ChildProcess("camera", command, environment(domain)) as process:
        yield process
