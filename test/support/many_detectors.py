"""Twelve detectors in one process, with models of the test's that have 80 classes.

The first is active, the others are unconfigured.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import rclpy
from rclpy.executors import SingleThreadedExecutor

from support.colcon_workspace import SUPPORT_PATH
from support.detector_process import environment
from support.preparations import Preparations
from support.worker import worker_domain
from yolov5_lifecycle.ros.child_process import ChildProcess
from yolov5_lifecycle.ros.detector.node import DetectorNode
from yolov5_lifecycle.ros.nodes import stop_event

NAMES = tuple(f"/detector_{number:02}" for number in range(12))
ACTIVE = NAMES[0]
CLASS_NAMES = tuple(f"class {number}" for number in range(80))
_SPIN_S = 0.05


@contextmanager
def many_detectors() -> Iterator[tuple[ChildProcess, int]]:
    """The process, and the domain of its own that it is in."""
    with worker_domain() as domain:
        command = [sys.executable, __file__]
        with ChildProcess("many detectors", command, environment(domain) | SUPPORT_PATH) as process:
            yield process, domain


def main() -> None:
    """Serve all until a signal."""
    stop = stop_event()
    rclpy.init(args=[])
    executor = SingleThreadedExecutor()
    for name in NAMES:
        node = _detector(name)
        executor.add_node(node)
        executor.create_task(node.autostart)
    while not stop.is_set():
        executor.spin_once(timeout_sec=_SPIN_S)


def _detector(name: str) -> DetectorNode:
    prepare = Preparations()
    prepare.class_names = CLASS_NAMES  # type: ignore[assignment]
    is_started = str(name == ACTIVE).lower()
    words = ["--ros-args", "-r", f"__node:={name[1:]}", "-p", f"autostart:={is_started}"]
    return DetectorNode(prepare=prepare, cli_args=words)


if __name__ == "__main__":
    main()
