"""Subscriptions to depth images and their camera_info."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.detector.depth_placing import DepthPlacing
from yolov5_lifecycle.ros.detector.depth_status import DepthStatus, SourceStatus
from yolov5_lifecycle.ros.detector.frame_failures import RECENT_S
from yolov5_lifecycle.ros.detector.published_images import COMPRESSED, RAW, camera_of, remedy, similar_images
from yolov5_lifecycle.ros.detector.subscription import Subscription
from yolov5_lifecycle.ros.topics import DEPTH_CAMERA_INFO, DEPTH_IMAGE_RAW, full_name, of_camera

_QUEUE = 2


class DepthInput:
    """Owns both subscriptions while depth is needed, and the `DepthPlacing` that uses their messages.

    `camera`: see `of_camera`. `slop_s` is the setting `depth_slop_s`. If a subscription cannot be created, 2D
    detection continues; every `look` retries.
    """

    def __init__(self, node: Node, *, camera: str = "", slop_s: float) -> None:
        self._node = node
        self._camera = camera
        self.slop_s = slop_s
        self.placing = DepthPlacing(node, slop_s=slop_s)
        self._subscriptions: list[Subscription] = []
        """To depth images and to camera_info; empty while depth is not needed."""

    def follow(self, *, is_needed: bool) -> None:
        """Subscribe if depth is needed, else unsubscribe."""
        if is_needed and not self._subscriptions:
            self._subscriptions = [
                self._subscribed(DEPTH_IMAGE_RAW, Image, self.placing.take_image),
                self._subscribed(
                    DEPTH_CAMERA_INFO, CameraInfo, self.placing.take_camera_info, takes_latched=True
                ),
            ]
        elif not is_needed and self._subscriptions:
            for subscription in self._subscriptions:
                subscription.close()
            self._subscriptions = []
            self.placing.forget()

    def _subscribed(
        self, topic: str, message_type: type, take: Callable[[Any], None], *, takes_latched: bool = False
    ) -> Subscription:
        subscription = Subscription(
            self._node,
            of_camera(topic, self._camera),
            message_type,
            take,
            depth=_QUEUE,
            takes_latched=takes_latched,
        )
        subscription.follow()
        return subscription

    def look(self) -> DepthStatus:
        """Update the subscriptions to what the publishers offer; return the status."""
        image, camera_info = [_looked_at(each) for each in self._subscriptions] or (None, None)
        if image is not None and image.publishers == 0:
            image = self._in_another_form(image)
        is_recent = time.monotonic() - self.placing.rejected_s < RECENT_S
        return DepthStatus(
            image=image,
            camera_info=camera_info,
            counts=self.placing.counts,
            run=self.placing.run,
            recently_rejected=self.placing.rejection if is_recent else "",
        )

    def _in_another_form(self, image: SourceStatus) -> SourceStatus:
        """`image` with what to type if the same images are published by another transport."""
        local = of_camera(DEPTH_IMAGE_RAW, self._camera)
        name = full_name(self._node, local)
        found = similar_images(
            self._node,
            name,
            transport=RAW,
            usable=(RAW,),
            is_candidate=lambda other: camera_of(other) == camera_of(name),
        )
        # JPEG cannot hold distances.
        best = min(found, key=lambda images: images.form == COMPRESSED, default=None)
        if best is None:
            return image
        clause = remedy(self._node, best, topics={RAW: DEPTH_IMAGE_RAW}, transport=RAW, camera=self._camera)
        return replace(image, sent_as=in_one_line(best.name), remedy=clause)


def _looked_at(subscription: Subscription) -> SourceStatus:
    """Status of the subscription, updated to what the publishers offer."""
    subscription.follow()
    return SourceStatus(
        subscription.name, subscription.publishers, subscription.missing_s, subscription.problem
    )
