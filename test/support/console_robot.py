"""Camera, detector and console as processes in a ROS domain of their own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from support.camera_process import camera_process
from support.console_process import address, console_process
from support.detector_process import (
    NODE,
    PARAMETERS,
    DetectorProcess,
    as_arguments,
    detector_process,
)

CAMERA = (
    *("--ros-args", "-r", f"image_raw:={NODE}/image_raw", "-p", "seed:=8", "-p", "rate:=15.0"),
    *("-p", "width:=320", "-p", "height:=240"),
)


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
def console_robot() -> Iterator[ConsoleRobot]:
    """Camera, detector and console."""
    with (
        detector_process(*as_arguments(PARAMETERS)) as detector,
        camera_process(detector.domain, *CAMERA),
        console_process(detector.domain) as console,
    ):
        yield ConsoleRobot(detector, address(console))
