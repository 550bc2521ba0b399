"""Subscriptions to depth images and their camera_info."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import CameraInfo, Image

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.detector.depth_placing import DepthPlacing
from yolov5_lifecycle.ros.detector.depth_status import DepthStatus, SourceStatus
from yolov5_lifecycle.ros.detector.frame_failures import RECENT_S
from yolov5_lifecycle.ros.detector.image_input import common_reliability
from yolov5_lifecycle.ros.qos_overrides import overridden_reliability, overriding_options
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
    """Subscription with keep last 2 and the reliability that the publishers offer or an override sets."""

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
        self._topic = topic
        self._name = full_name(node, topic)
        self._message_type = message_type
        self._type_name = f"{message_type.__module__.partition('.')[0]}/msg/{message_type.__name__}"
        self._take = take
        self._clock = clock
        self._overridden = overridden_reliability(node, topic)
        self._seen_s = clock()
        self._problem = ""
        self._reliability = ReliabilityPolicy.BEST_EFFORT
        self._subscription: Any = None
        self._follow(self._publishers())

    def look(self) -> SourceStatus:
        """Query the ROS graph; resubscribe if publishers offer another reliability, or after a failure."""
        publishers = self._publishers()
        self._follow(publishers)
        now_s = self._clock()
        if publishers:
            self._seen_s = now_s
        return SourceStatus(in_one_line(self._name), len(publishers), now_s - self._seen_s, self._problem)

    def close(self) -> None:
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _publishers(self) -> list[TopicEndpointInfo]:
        infos = self._node.get_publishers_info_by_topic(self._name)
        return [info for info in infos if info.topic_type == self._type_name]

    def _follow(self, publishers: list[TopicEndpointInfo]) -> None:
        offered = common_reliability([info.qos_profile.reliability for info in publishers])
        wanted = offered if self._overridden is None else self._overridden
        if self._subscription is None or wanted is not self._reliability:
            self.close()
            self._reliability = wanted
            self._subscribe()

    def _subscribe(self) -> None:
        try:
            self._subscription = self._node.create_subscription(
                self._message_type,
                self._topic,
                self._take,
                QoSProfile(depth=_QUEUE, history=HistoryPolicy.KEEP_LAST, reliability=self._reliability),
                qos_overriding_options=overriding_options(self._node, self._topic, "subscription"),
            )
        except Exception as error:  # noqa: BLE001 - rclpy raises several types; reported and retried
            problem = f"cannot subscribe to {in_one_line(self._name)}: {in_one_line(str(error))}"
            if problem != self._problem:
                self._node.get_logger().error(problem)
            self._problem = problem
        else:
            self._problem = ""
