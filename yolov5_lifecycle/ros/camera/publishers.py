"""Publishers whose QoS a user of the camera can override."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CameraInfo


def overridable_publisher(node: Node, message_type: type, topic: str, **policies: Any) -> Any:
    """Publisher that keeps the last message, with these `policies` unless `qos_overrides` set others."""
    overridable = QoSOverridingOptions.with_default_policies()
    qos = QoSProfile(depth=1, **policies)
    return node.create_publisher(message_type, topic, qos, qos_overriding_options=overridable)


def camera_info_publisher(node: Node, folder: str) -> Any:
    """Publisher of `camera_info` next to the images in `folder`; late subscribers get the last one."""
    transient = DurabilityPolicy.TRANSIENT_LOCAL
    return overridable_publisher(node, CameraInfo, f"{folder}/camera_info", durability=transient)
