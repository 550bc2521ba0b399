"""Publishers on the expected image topic, and similar topics that carry images."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import CompressedImage, Image

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.topics import COMPRESSED_IMAGE_RAW, IMAGE_RAW, full_name, of_camera, used_otherwise
from yolov5_lifecycle.settings.suggestion import most_similar

Transport = Literal["raw", "compressed"]

TOPICS: dict[Transport, tuple[str, type]] = {
    "raw": (IMAGE_RAW, Image),
    "compressed": (COMPRESSED_IMAGE_RAW, CompressedImage),
}
_TYPE_NAMES = {"raw": "sensor_msgs/msg/Image", "compressed": "sensor_msgs/msg/CompressedImage"}
DISCOVERY_S = 5.0
"""Time that ROS may take to discover publishers."""
_SEARCH_EVERY_S = 5.0
_NOT_COLOUR = {"mask", "label", "segmentation", "semantic", "instance", "depth", "disparity"}
"""Words in the names of topics with images whose pixels are labels or distances."""
_MAX_CANDIDATES = 200
_MAX_ASKED = 20
_MAX_SHOWN = 3


@dataclass(frozen=True)
class TopicStatus:
    """Publishers of the image topic in the ROS graph.

    `reliabilities`: offered by each publisher of the right type. `gids`: their gids. `other_types`: types of
    the other publishers, which never match. `missing_s`: seconds without a publisher of the right type.
    `similar`: other topics with images, searched only while this topic has no such publisher.
    """

    name: str
    reliabilities: tuple[ReliabilityPolicy, ...] = ()
    gids: frozenset[bytes] = frozenset()
    other_types: tuple[str, ...] = ()
    missing_s: float = 0.0
    similar: tuple[str, ...] = ()

    @property
    def publishers(self) -> int:
        return len(self.reliabilities)


class ImageTopic:
    """Monitors the image topic of a camera, whether or not the node subscribes to it.

    `camera`: see `of_camera`. `cameras()` returns all cameras of the node, whose topics are not suggested for
    this one. `clock` returns monotonic seconds.
    """

    def __init__(
        self,
        node: Node,
        transport: Transport,
        *,
        camera: str = "",
        cameras: Callable[[], Sequence[str]] = lambda: ("",),
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._node = node
        self._camera = camera
        self._cameras = cameras
        self._clock = clock
        self.transport = transport
        self.name = full_name(node, self.local_name)
        self._seen_s = clock()
        self._similar: tuple[str, ...] = ()
        self._searched_s = float("-inf")

    @property
    def local_name(self) -> str:
        """Name before remapping, such as ~/image_raw."""
        return of_camera(TOPICS[self.transport][0], self._camera)

    def follow(self, transport: Transport) -> None:
        """Switch to the topic of `transport`."""
        if transport != self.transport:
            self.transport = transport
            self.name = full_name(self._node, self.local_name)
            self._seen_s, self._similar, self._searched_s = self._clock(), (), float("-inf")

    def look(self) -> TopicStatus:
        """Query the ROS graph, which is cached in this process."""
        infos = self._node.get_publishers_info_by_topic(self.name)
        ours = [info for info in infos if info.topic_type == _TYPE_NAMES[self.transport]]
        now_s = self._clock()
        if ours:
            self._seen_s, self._similar, self._searched_s = now_s, (), float("-inf")
        elif now_s - self._searched_s >= _SEARCH_EVERY_S:
            self._similar, self._searched_s = self._search(), now_s
        return TopicStatus(
            name=in_one_line(self.name),
            reliabilities=tuple(info.qos_profile.reliability for info in ours),
            gids=frozenset(map(_gid, ours)),
            other_types=tuple(sorted({in_one_line(info.topic_type) for info in infos if info not in ours})),
            missing_s=now_s - self._seen_s,
            similar=self._similar,
        )

    def publisher(self) -> bytes | None:
        """Gid of the only publisher, None unless there is exactly one."""
        gids = [_gid(info) for info in self._node.get_publishers_info_by_topic(self.name)]
        return gids[0] if len(gids) == 1 else None

    def _search(self) -> tuple[str, ...]:
        """Other topics with an image publisher, most similar name first; queries a bounded number."""
        elsewhere = used_otherwise(self._camera, self._cameras())
        own = {full_name(self._node, topic) for topic in elsewhere} | {self.name}
        candidates = [
            name
            for name, types in self._node.get_topic_names_and_types()
            if name not in own
            and any(type_name in types for type_name in _TYPE_NAMES.values())
            and not (_words(name) & _NOT_COLOUR) - _words(self.name)
        ]
        ranked = most_similar(self.name, candidates[:_MAX_CANDIDATES])[:_MAX_ASKED]
        published = [name for name in ranked if self._node.count_publishers(name)]
        return tuple(map(in_one_line, published[:_MAX_SHOWN]))


def _words(name: str) -> set[str]:
    """The words of the name of a topic, as in camera, image and raw of /camera/image_raw."""
    return {word.lower().removesuffix("s") for word in re.split(r"[/_]", name)}


def _gid(info: TopicEndpointInfo) -> bytes:
    return bytes(info.endpoint_gid)
