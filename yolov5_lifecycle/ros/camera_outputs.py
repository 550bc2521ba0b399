"""What the camera publishes: images, their size, and what the synthetic scene shows."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray

from yolov5_lifecycle.detections import Detections
from yolov5_lifecycle.picture_source import SourceFrame
from yolov5_lifecycle.ros.camera_settings import CameraSettings
from yolov5_lifecycle.ros.camera_transport import IMAGE_FORMS, ImageForm, Transport
from yolov5_lifecycle.ros.messages import detection_array
from yolov5_lifecycle.scene import CLASS_NAMES, Truth

_RELIABILITIES = {"reliable": ReliabilityPolicy.RELIABLE, "best_effort": ReliabilityPolicy.BEST_EFFORT}


class CameraOutputs:
    """Owns the publishers of the images, of `camera_info` beside them, and of `~/truth`.

    Everything follows where `image_raw` is remapped to, as with image_transport. `camera_info` says that the
    camera is not calibrated; the last one is kept for late subscribers. `~/truth` has the shapes of the
    synthetic scene, sent before their image. What nobody has subscribed to is not made; `forms` make it.

    Raises RuntimeError or ParameterException at birth for `qos_overrides` that make no sense.
    """

    def __init__(
        self,
        node: Node,
        settings: CameraSettings,
        *,
        forms: Mapping[Transport, Sequence[ImageForm]] = IMAGE_FORMS,
    ) -> None:
        self._node = node
        self._settings = settings
        topic = node.resolve_topic_name("image_raw")
        offered = _RELIABILITIES[settings.reliability]
        self._images = [
            (self._publisher(form.message_type, f"{topic}{form.suffix}", reliability=offered), form.message)
            for form in forms[settings.image_transport]
        ]
        self._infos = self._publisher(
            CameraInfo,
            f"{topic.rpartition('/')[0]}/camera_info",
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
        self._truths = node.create_publisher(Detection2DArray, "~/truth", 10)

    @property
    def image_topics(self) -> list[str]:
        """The full names of the topics that have the images."""
        return [publisher.topic_name for publisher, _ in self._images]

    @property
    def is_heard(self) -> bool:
        """Whether somebody has subscribed to the images."""
        return any(publisher.get_subscription_count() for publisher, _ in self._images)

    def publish(self, frame: SourceFrame) -> None:
        """Send one frame, stamped now, in the forms that somebody has subscribed to."""
        header = Header(stamp=self._node.get_clock().now().to_msg(), frame_id=self._settings.frame_id)
        if frame.truth is not None and self._truths.get_subscription_count():
            self._truths.publish(detection_array(_certain(frame.truth), CLASS_NAMES, header))
        for publisher, message in self._images:
            if publisher.get_subscription_count():
                publisher.publish(message(frame.picture, self._settings.encoding, header))
        height, width = frame.picture.size_hw
        self._infos.publish(CameraInfo(header=header, height=height, width=width))

    def wait_until_delivered(self, timeout_s: float) -> None:
        """Wait until reliable subscribers have everything, but no longer than `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        for publisher in (*(publisher for publisher, _ in self._images), self._infos, self._truths):
            left_s = max(0.0, deadline_s - time.monotonic())
            publisher.wait_for_all_acked(Duration(seconds=left_s))

    def _publisher(self, message_type: type, topic: str, **policies: Any) -> Any:
        overridable = QoSOverridingOptions.with_default_policies()
        qos = QoSProfile(depth=1, **policies)
        return self._node.create_publisher(message_type, topic, qos, qos_overriding_options=overridable)


def _certain(truth: Truth) -> Detections:
    """The truth as detections of score 1."""
    return Detections(truth.boxes_xyxy, np.ones(len(truth.boxes_xyxy), np.float32), truth.class_ids)
