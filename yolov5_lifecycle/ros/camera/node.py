"""Executable `camera`: publishes images from a synthetic scene, a device, a video or image files."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Sequence
from typing import NoReturn

import rclpy
from rclpy.exceptions import ParameterException

from yolov5_lifecycle.process.standard_streams import complain, flush_output
from yolov5_lifecycle.ros.camera.outputs import CameraOutputs
from yolov5_lifecycle.ros.camera.settings import SCHEMA, check_qos_overrides
from yolov5_lifecycle.ros.nodes import PrintableNode, spin, stop_event
from yolov5_lifecycle.ros.parameters.declaration import declare
from yolov5_lifecycle.ros.rclpy_internals import ResilientExecutor
from yolov5_lifecycle.ros.services import wrap_services
from yolov5_lifecycle.ros.shared_memory import shared_memory_problems
from yolov5_lifecycle.ros.start_arguments import explain, initialize, refuse, start_arguments
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.sources.frames import ImageSource, Playback, SourceFrame
from yolov5_lifecycle.sources.source import open_source

_DELIVERY_S = 1.0
_END_S = 2.0  # longer than the delivery of the current frame may take
_USAGE = """\
camera: publishes images on image_raw or image_raw/compressed, their size on camera_info in the same
namespace, and the ground truth of the synthetic scene on ~/truth and ~/ground_truth_masks.
Pass parameters as in `camera --ros-args -p source:=video.mp4 -r image_raw:=/yolov5/image_raw`:"""


class CameraNode(PrintableNode):
    """Publishes the frames of a source at a constant rate until the source ends or fails.

    Without `loop`, playback starts with the first subscriber and waits for the delivery of each frame, so
    that a reliable subscriber with a sufficient queue loses none.

    Raises SettingsError, RuntimeError or ParameterException on construction for invalid parameters.
    """

    def __init__(self) -> None:
        super().__init__("camera")
        values = declare(self, SCHEMA)
        self._settings = SCHEMA.validated(values)
        self._outputs = CameraOutputs(self, self._settings)
        check_qos_overrides(self)
        wrap_services(self, {})
        if not self._settings.loop:
            self.get_logger().info(f"waiting for a subscriber to {self._outputs.topics}")
        self._stop = threading.Event()
        self._rate = ""
        self.playback = Playback(
            self._open,
            self._show,
            rate_hz=self._settings.rate,
            is_awaited=lambda: self._settings.loop or self._outputs.is_heard,
        )

    def close(self) -> None:
        """Stop, wait for delivery and destroy the node; the thread of a hung source is abandoned."""
        self._stop.set()
        if self.playback.stop(_END_S):
            self._outputs.wait_until_delivered(_DELIVERY_S)
        self.destroy_node()

    def _open(self) -> ImageSource:
        source = open_source(
            self._settings.source,
            size_hw=self._settings.size_hw,
            seed=self._settings.seed,
            depth=self._settings.depth,
            loop=self._settings.loop,
            report=self.get_logger().warning,
            wait=self._stop.wait,
        )
        rate_hz = self._settings.rate or source.rate_hz
        self._rate = f"at {rate_hz:g} images per second" if rate_hz else "at the rate of the source"
        return source

    def _show(self, frame: SourceFrame) -> None:
        self._outputs.publish(frame)
        height, width = frame.image.size_hw
        shown = f"{width} x {height} ({self._settings.encoding}) {self._rate}"
        self.get_logger().info(f"publishing {shown} on {self._outputs.topics}", once=True)
        if not self._settings.loop:
            self._outputs.wait_until_delivered(_DELIVERY_S)


def main(args: Sequence[str] | None = None) -> NoReturn:
    """Publish until a signal or the end of the source, then exit the process.

    The exit code is 0 after a clean end, 1 if the source failed, 2 for invalid arguments or parameters.
    """
    code = _run(list(sys.argv if args is None else args))
    # Python aborts if a thread returns from a device call during interpreter shutdown.
    flush_output("camera", code)  # the reader of the pipe may have exited
    os._exit(code)


def _run(arguments: list[str]) -> int:
    stop = stop_event()
    shortages = shared_memory_problems()
    try:
        given = start_arguments(arguments)
        if words := given.own_words:
            return explain("camera", words, usage=_USAGE, settings=SCHEMA.settings)
        if given.problems:
            return refuse("camera", " ".join(given.problems))
        initialize(given.words)
        node = CameraNode()
    except (RuntimeError, ParameterException, SettingsError) as error:
        return refuse("camera", error)
    for shortage in shortages:
        node.get_logger().warning(shortage)
    executor = ResilientExecutor()
    executor.add_node(node)
    spin(executor, node, until=lambda: stop.is_set() or node.playback.is_finished)
    failure = node.playback.failure  # read before `close`: only failures up to here count
    node.close()
    rclpy.try_shutdown()
    if failure:
        complain("camera", failure)
    return 1 if failure else 0


if __name__ == "__main__":
    main()
