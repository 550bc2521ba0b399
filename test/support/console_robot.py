"""Camera, detector and console as processes in a ROS domain of their own."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from support.camera_process import camera_process
from support.detector_process import (
    NODE,
    PARAMETERS,
    DetectorProcess,
    as_arguments,
    detector_process,
    environment,
)
from yolov5_lifecycle.ros.demo.child_process import ChildProcess, entry_point
from yolov5_lifecycle.ros.demo.observer import PATIENCE_S

CAMERA = (
    *("--ros-args", "-r", f"image_raw:={NODE}/image_raw", "-p", "seed:=8", "-p", "rate:=15.0"),
    *("-p", "width:=320", "-p", "height:=240"),
)
_ADDRESS = re.compile(r"console: (http\S+)")


@dataclass(frozen=True)
class ConsoleRobot:
    """What a person at the page looks at; `url` is that of the page."""

    detector: DetectorProcess
    url: str

    def reset(self) -> None:
        """Parameters as at the start, and the detector active."""
        self.detector.reset()
        self.detector.bring_to("active")


@contextmanager
def console_robot(*arguments: str) -> Iterator[ConsoleRobot]:
    """Camera, detector and a console that is given `arguments`."""
    with (
        detector_process(*as_arguments(PARAMETERS)) as detector,
        camera_process(detector.domain, *CAMERA),
        console_process(detector.domain, *arguments) as console,
    ):
        yield ConsoleRobot(detector, address(console))


@contextmanager
def console_process(domain: int, *arguments: str, port: int = 0) -> Iterator[ChildProcess]:
    """The installed `console` once it serves, with port 0 on a free port."""
    command = [entry_point("console"), "--port", str(port), *arguments]
    with ChildProcess("console", command, environment(domain)) as process:
        process.wait_for_output("console: http", PATIENCE_S)
        yield process


def address(console: ChildProcess) -> str:
    """The address that a console has announced."""
    found = _ADDRESS.search(console.output)
    assert found, console.output
    return found[1]
