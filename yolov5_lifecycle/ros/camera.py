"""Executable `camera`: images from a synthetic scene, a device, a video or picture files."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
import rclpy
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.detections import Detections
from yolov5_lifecycle.image_encoding import encoded
from yolov5_lifecycle.images import ImageError
from yolov5_lifecycle.picture_source import SourceError, SourceFrame, open_source
from yolov5_lifecycle.ros.camera_settings import CameraSettings, declared_settings
from yolov5_lifecycle.ros.command_line import complain, explain
from yolov5_lifecycle.ros.messages import detection_array, image_message
from yolov5_lifecycle.ros.process import spin, stop_event
from yolov5_lifecycle.ros.services import harden
from yolov5_lifecycle.scene import CLASS_NAMES, Truth
from yolov5_lifecycle.settings import SettingsError

_RELIABILITIES = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}
_DELIVERY_S = 1.0
_USAGE = """\
camera: publishes images on image_raw, and what the synthetic scene shows on ~/truth.
Parameters are given as in `camera --ros-args -p source:=video.mp4 -r image_raw:=/yolov5/image_raw`:"""


class CameraNode(Node):
    """Publishes the frames of a source at an even rate until they end or fail.

    Owns the source. `~/truth` has the shapes of the synthetic scene with the stamp of the image they are in,
    sent before that image.

    Raises SettingsError or SourceError at birth, for parameters that cannot be used.
    """

    def __init__(self) -> None:
        super().__init__("camera")
        self.is_finished = False
        self.failure = ""
        self._settings = declared_settings(self)
        self._frames = open_source(
            self._settings.source,
            size_hw=self._settings.size_hw,
            seed=self._settings.seed,
            loop=self._settings.loop,
        )
        self._images = self.create_publisher(
            Image, "image_raw", QoSProfile(depth=1, reliability=_RELIABILITIES[self._settings.reliability])
        )
        self._truths = self.create_publisher(Detection2DArray, "~/truth", 10)
        self._timer = self.create_timer(1 / self._settings.rate, self._publish_next)
        harden(self, {})

    def close(self) -> None:
        """Deliver what was sent and destroy the node."""
        if self.is_finished:
            self._images.wait_for_all_acked(Duration(seconds=_DELIVERY_S))
        self.destroy_node()

    def _publish_next(self) -> None:
        try:
            frame = next(self._frames, None)
        except (SourceError, ImageError) as error:
            self.failure, self.is_finished = str(error), True
            return
        if frame is None:
            self.is_finished = True
        elif not self.is_finished:
            self._publish(frame)

    def _publish(self, frame: SourceFrame) -> None:
        header = Header(stamp=self.get_clock().now().to_msg(), frame_id=self._settings.frame_id)
        if frame.truth is not None:
            self._truths.publish(detection_array(_certain(frame.truth), CLASS_NAMES, header))
        encoding = self._settings.encoding
        self._images.publish(image_message(encoded(frame.picture, encoding), encoding, header))


def main(args: Sequence[str] | None = None) -> int:
    """Publish until a signal or the end of the source.

    Returns 0 after a clean end, 1 when the source failed, 2 for wrong arguments or parameters.
    """
    arguments = list(sys.argv if args is None else args)
    stop = stop_event()
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        if words := remove_ros_args(arguments)[1:]:
            return explain("camera", words, usage=_USAGE, parameters=_parameters())
        node = CameraNode()
    except (RuntimeError, SettingsError, SourceError) as error:
        return complain("camera", error)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spin(executor, node, until=lambda: stop.is_set() or node.is_finished)
    node.close()
    rclpy.try_shutdown()
    if node.failure:
        sys.stderr.write(f"camera: {node.failure}\n")
    return 1 if node.failure else 0


def _parameters() -> list[tuple[str, str | None, object]]:
    return [(name, field.description, field.default) for name, field in CameraSettings.model_fields.items()]


def _certain(truth: Truth) -> Detections:
    """The truth as detections of score 1."""
    return Detections(truth.boxes_xyxy, np.ones(len(truth.boxes_xyxy), np.float32), truth.class_ids)


if __name__ == "__main__":
    sys.exit(main())
