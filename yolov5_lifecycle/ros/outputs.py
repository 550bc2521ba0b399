"""What the node publishes from configure to cleanup."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from vision_msgs.msg import Detection2DArray, LabelInfo

_LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Outputs:
    """Owns the publishers of detections, annotated images and labels.

    `on_listeners_changed()` is called in the executor when somebody starts or stops to listen.
    """

    def __init__(self, node: LifecycleNode, *, on_listeners_changed: Callable[[], None]) -> None:
        self._node = node
        events = PublisherEventCallbacks(matched=lambda _: on_listeners_changed())
        self.detections: LifecyclePublisher = node.create_lifecycle_publisher(
            Detection2DArray, "~/detections", QoSProfile(depth=10), event_callbacks=events
        )
        self.image: LifecyclePublisher = node.create_lifecycle_publisher(
            Image,
            "~/image",
            QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE),
            event_callbacks=events,
        )
        self.label_info: LifecyclePublisher = node.create_lifecycle_publisher(
            LabelInfo, "~/label_info", _LATCHED
        )

    @property
    def listeners(self) -> int:
        """Subscriptions that need frames to be detected."""
        return int(self.detections.get_subscription_count()) + self.image_listeners

    @property
    def image_listeners(self) -> int:
        return int(self.image.get_subscription_count())

    def close(self) -> None:
        for publisher in (self.detections, self.image, self.label_info):
            # destroy_publisher would leave it among the managed entities.
            self._node.destroy_lifecycle_publisher(publisher)
