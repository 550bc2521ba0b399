"""The node's publishers, which exist from configure to cleanup."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import KW_ONLY, dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import Header
from vision_msgs.msg import Detection2DArray, Detection3DArray, LabelInfo

from yolov5_lifecycle.images.compressed import encode_jpeg
from yolov5_lifecycle.images.image import ColourImage, ImageError
from yolov5_lifecycle.ros.messages import compressed_image_message, image_message
from yolov5_lifecycle.ros.qos_overrides import overriding_options
from yolov5_lifecycle.ros.topics import (
    COMPRESSED_IMAGE,
    DETECTIONS,
    DETECTIONS_3D,
    IMAGE,
    LABEL_INFO,
    MASKS,
    endpoint_name,
    of_camera,
)
from yolov5_lifecycle.streaming.inference_threads import Send


def label_info_publisher(node: LifecycleNode) -> LifecyclePublisher:
    """Latched publisher of the class names, one for all cameras. Raises rclpy's exception."""
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    return _created(node, LabelInfo, LABEL_INFO, latched)


@dataclass(eq=False)
class Outputs:
    """Owns the publishers of a camera's detections, masks and annotated images.

    `camera`: see `of_camera`. `on_subscribers_changed()` is called in the executor when a subscriber joins or
    leaves.

    Raises rclpy's exception if a publisher cannot be created, after destroying the others.
    """

    node: LifecycleNode
    _: KW_ONLY
    camera: str = ""
    on_subscribers_changed: Callable[[], None]

    def __post_init__(self) -> None:
        self._events = PublisherEventCallbacks(matched=lambda _: self.on_subscribers_changed())
        self._publishers: list[LifecyclePublisher] = []
        try:
            self.detections = self._publisher(Detection2DArray, DETECTIONS, depth=10)
            self.detections_3d = self._publisher(Detection3DArray, DETECTIONS_3D, depth=10)
            self._masks = self._publisher(Image, MASKS, depth=1)
            self._image = self._publisher(Image, IMAGE, depth=1)
            self._compressed_image = self._publisher(CompressedImage, COMPRESSED_IMAGE, depth=1)
        except Exception:
            self.close()
            raise

    @property
    def subscribers(self) -> int:
        """Number of subscriptions that need inference with any model and settings."""
        return int(self.detections.get_subscription_count()) + self.image_subscribers

    @property
    def subscribers_3d(self) -> int:
        """Number of subscriptions to detections in space."""
        return int(self.detections_3d.get_subscription_count())

    @property
    def mask_subscribers(self) -> int:
        """Number of subscriptions to masks."""
        return int(self._masks.get_subscription_count())

    @property
    def image_subscribers(self) -> int:
        """Number of subscriptions that need annotated images."""
        compressed = self._compressed_image.get_subscription_count()
        return int(self._image.get_subscription_count() + compressed)

    def masks_message(self, label_image: NDArray[np.uint16], header: Header) -> Send:
        """A message with the detection that each pixel (H, W) belongs to; see `Detections.label_image`."""
        return partial(self._masks.publish, image_message(label_image, "16UC1", header))

    def image_messages(self, image: ColourImage, header: Header) -> Iterator[Send]:
        """Messages with an annotated image, raw and compressed, for each topic that has a subscriber."""
        if self._image.get_subscription_count():
            yield partial(self._image.publish, image_message(image.pixels, f"{image.order}8", header))
        if self._compressed_image.get_subscription_count():
            try:
                jpeg = encode_jpeg(image)
            except ImageError as error:
                # The detections are published; only the compressed image is missing.
                self.node.get_logger().warning(
                    f"no image on {of_camera(COMPRESSED_IMAGE, self.camera)}: {error}",
                    throttle_duration_sec=5.0,
                )
                return
            message = compressed_image_message(jpeg, f"{image.order}8", header)
            yield partial(self._compressed_image.publish, message)

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in self._publishers:
            # destroy_publisher would leave it in the list of managed entities.
            self.node.destroy_lifecycle_publisher(publisher)
        self._publishers.clear()

    def _publisher(self, message_type: type, topic: str, *, depth: int) -> LifecyclePublisher:
        name = of_camera(topic, self.camera)
        publisher = _created(self.node, message_type, name, QoSProfile(depth=depth), self._events)
        self._publishers.append(publisher)
        return publisher


def _created(
    node: LifecycleNode,
    message_type: type,
    topic: str,
    qos: QoSProfile,
    events: PublisherEventCallbacks | None = None,
) -> LifecyclePublisher:
    return node.create_lifecycle_publisher(
        message_type,
        endpoint_name(node, topic),
        qos,
        event_callbacks=events,
        qos_overriding_options=overriding_options(node, topic, "publisher"),
    )
