"""Executable `camera`: images from a synthetic scene, a device, a video or picture files."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import partial
from typing import NoReturn

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from yolov5_lifecycle.picture_source import SourceFrame, open_source
from yolov5_lifecycle.playback import Playback
from yolov5_lifecycle.ros.camera_outputs import CameraOutputs
from yolov5_lifecycle.ros.camera_settings import CameraSettings, check_qos_overrides, declared_settings
from yolov5_lifecycle.ros.command_line import complain, explain
from yolov5_lifecycle.ros.process import spin, stop_event
from yolov5_lifecycle.ros.services import harden
from yolov5_lifecycle.settings import SettingsError

_DELIVERY_S = 1.0
_END_S = 2.0  # longer than a frame under way may take to be delivered
_USAGE = """\
camera: publishes images on image_raw or image_raw/compressed, their size on camera_info beside it, and
what the synthetic scene shows on ~/truth.
Parameters are given as in `camera --ros-args -p source:=video.mp4 -r image_raw:=/yolov5/image_raw`:"""


class CameraNode(Node):
    """Publishes the frames of a source at an even rate until they end or fail.

    What is played once begins when somebody listens and goes on when they have each frame, so that none is
    lost to a reliable subscriber that keeps them.

    Raises SettingsError, RuntimeError or ParameterException at birth, for parameters that cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("camera")
        self._settings = declared_settings(self)
        self._outputs = CameraOutputs(self, self._settings)
        check_qos_overrides(self)
        harden(self, {})
        if not self._settings.loop:
            self.get_logger().info(f"waiting for a subscriber to {' or '.join(self._outputs.image_topics)}")
        self._playback = Playback(
            partial(
                open_source,
                self._settings.source,
                size_hw=self._settings.size_hw,
                seed=self._settings.seed,
                loop=self._settings.loop,
            ),
            self._show,
            rate_hz=self._settings.rate,
            is_awaited=lambda: self._settings.loop or self._outputs.is_heard,
        )

    @property
    def is_finished(self) -> bool:
        """Whether the source has ended or failed."""
        return self._playback.is_finished

    @property
    def failure(self) -> str:
        """Why the source failed, "" as long as it did not."""
        return self._playback.failure

    def close(self) -> None:
        """Stop, deliver what was sent and destroy the node; a source that hangs is left behind."""
        if self._playback.stop(_END_S):
            self._outputs.wait_until_delivered(_DELIVERY_S)
        self.destroy_node()

    def _show(self, frame: SourceFrame) -> None:
        self._outputs.publish(frame)
        if not self._settings.loop:
            self._outputs.wait_until_delivered(_DELIVERY_S)


def main(args: Sequence[str] | None = None) -> NoReturn:
    """Publish until a signal or the end of the source, and end the process.

    The code is 0 after a clean end, 1 when the source failed, 2 for wrong arguments or parameters.
    """
    code = _run(list(sys.argv if args is None else args))
    # Python aborts when a thread comes back from a device while it clears away.
    sys.stdout.flush()
    os._exit(code)


def _run(arguments: list[str]) -> int:
    stop = stop_event()
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        if words := remove_ros_args(arguments)[1:]:
            return explain("camera", words, usage=_USAGE, parameters=_parameters())
        node = CameraNode()
    except (RuntimeError, ParameterException, SettingsError) as error:
        return complain("camera", error)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spin(executor, node, until=lambda: stop.is_set() or node.is_finished)
    failure = node.failure  # as it was when the end began
    node.close()
    rclpy.try_shutdown()
    if failure:
        sys.stderr.write(f"camera: {failure}\n")
    return 1 if failure else 0


def _parameters() -> list[tuple[str, str | None, object]]:
    return [(name, field.description, field.default) for name, field in CameraSettings.model_fields.items()]


if __name__ == "__main__":
    main()
