"""Subscriptions to depth images and their camera_info."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.detector.depth_placing import DepthPlacing
from yolov5_lifecycle.ros.detector.depth_status import DepthStatus, SourceStatus
from yolov5_lifecycle.ros.detector.followed_topic import FollowedTopic
from yolov5_lifecycle.ros.detector.frame_failures import RECENT_S
from yolov5_lifecycle.ros.topics import DEPTH_CAMERA_INFO, DEPTH_IMAGE_RAW, full_name, of_camera

_QUEUE = 2


class DepthInput:
    """Owns both subscriptions while depth is needed, and the `DepthPlacing` that uses their messages.

    `camera`: see `of_camera`. `slop_s` is the setting `depth_slop_s`. `clock` returns monotonic seconds. A
    subscription that cannot be created is logged and retried by every `look`; 2D detection continues.
    """

    def __init__(
        self, node: Node, *, camera: str = "", slop_s: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._node = node
        self._camera = camera
        self._clock = clock
        self.slop_s = slop_s
        self.placing = DepthPlacing(node, slop_s=slop_s, clock=clock)
        self._sources: tuple[DepthSource, DepthSource] | None = None

    def follow(self, *, is_needed: bool) -> None:
        """Subscribe if depth is needed, else unsubscribe."""
        if is_needed and self._sources is None:
            self._sources = (
                self._source(DEPTH_IMAGE_RAW, Image, self.placing.take_image),
                self._source(DEPTH_CAMERA_INFO, CameraInfo, self.placing.take_camera_info),
            )
        elif not is_needed and self._sources is not None:
            for source in self._sources:
                source.close()
            self._sources = None
            self.placing.forget()

    def _source(self, topic: str, message_type: type, take: Callable[[Any], None]) -> DepthSource:
        return DepthSource(self._node, of_camera(topic, self._camera), message_type, take, clock=self._clock)

    def look(self) -> DepthStatus:
        """Update the subscriptions to what the publishers offer; return the status."""
        image, camera_info = (source.look() for source in self._sources) if self._sources else (None, None)
        is_recent = self._clock() - self.placing.rejected_s < RECENT_S
        return DepthStatus(
            image=image,
            camera_info=camera_info,
            counts=self.placing.counts,
            run=self.placing.run,
            recently_rejected=self.placing.rejection if is_recent else "",
        )


class DepthSource:
    """Owns the subscription to one of the topics of a depth camera; keep last 2."""

    def __init__(
        self,
        node: Node,
        topic: str,
        message_type: type,
        take: Callable[[Any], None],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._node = node
        self._name = full_name(node, topic)
        self._type_name = f"{message_type.__module__.partition('.')[0]}/msg/{message_type.__name__}"
        self._clock = clock
        self._seen_s = clock()
        self._messages = FollowedTopic(node, topic, message_type, take, depth=_QUEUE)
        self.look()

    def look(self) -> SourceStatus:
        """Query the ROS graph and update the subscription to what the publishers offer."""
        infos = self._node.get_publishers_info_by_topic(self._name)
        offers = [info.qos_profile for info in infos if info.topic_type == self._type_name]
        self._messages.follow([offer.reliability for offer in offers], [offer.durability for offer in offers])
        now_s = self._clock()
        if offers:
            self._seen_s = now_s
        name, missing_s = in_one_line(self._name), now_s - self._seen_s
        return SourceStatus(name, len(offers), missing_s, self._messages.problem)

    def close(self) -> None:
        self._messages.close()
