"""Publishers on the expected image topic, and similar topics that carry images."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import CompressedImage, Image

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.ros.detector.published_images import (
    TYPE_NAMES,
    PublishedImages,
    camera_of,
    remedy,
    similar_images,
)
from yolov5_lifecycle.ros.topics import COMPRESSED_IMAGE_RAW, IMAGE_RAW, full_name, of_camera, used_otherwise

Transport = Literal["raw", "compressed"]

TOPICS: dict[Transport, tuple[str, type]] = {
    "raw": (IMAGE_RAW, Image),
    "compressed": (COMPRESSED_IMAGE_RAW, CompressedImage),
}
_LOCAL_NAMES: Mapping[str, str] = {transport: name for transport, (name, _) in TOPICS.items()}
DISCOVERY_S = 5.0
"""Time that ROS may take to discover publishers."""
_SEARCH_EVERY_S = 5.0
_LABELS = {"mask", "label", "segmentation", "semantic", "instance"}
_NOT_COLOUR = _LABELS | {"depth", "compresseddepth", "disparity"}
"""Words in the names of topics with images whose pixels are labels or distances."""
_MAX_SHOWN = 3


@dataclass(frozen=True)
class TopicStatus:
    """Publishers of the image topic in the ROS graph.

    `reliabilities`: offered by each publisher of the right type. `gids`: their gids. `other_types`: types of
    the other publishers, which never match. `missing_s`: seconds without a publisher of the right type.
    `similar`: other topics with images, searched only while this topic has no such publisher. `sent_as`: the
    one that has the images of this camera in another form, "" if there is none. `remedy`: what to type to
    receive that one, else the first of `similar`.
    """

    name: str
    reliabilities: tuple[ReliabilityPolicy, ...] = ()
    gids: frozenset[bytes] = frozenset()
    other_types: tuple[str, ...] = ()
    missing_s: float = 0.0
    similar: tuple[str, ...] = ()
    sent_as: str = ""
    remedy: str = ""

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
        self._similar: list[PublishedImages] = []
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
            self._seen_s, self._similar, self._searched_s = self._clock(), [], float("-inf")

    def look(self) -> TopicStatus:
        """Query the ROS graph, which is cached in this process."""
        infos = self._node.get_publishers_info_by_topic(self.name)
        ours = [info for info in infos if info.topic_type == TYPE_NAMES[self.transport]]
        now_s = self._clock()
        if ours:
            self._seen_s, self._similar, self._searched_s = now_s, [], float("-inf")
        elif now_s - self._searched_s >= _SEARCH_EVERY_S:
            self._similar, self._searched_s = self._search(), now_s
        first = next(iter(self._similar), None)
        others = dict.fromkeys(in_one_line(each.name) for each in self._similar if each.name != self.name)
        return TopicStatus(
            name=in_one_line(self.name),
            reliabilities=tuple(info.qos_profile.reliability for info in ours),
            gids=frozenset(map(_gid, ours)),
            other_types=tuple(sorted({in_one_line(info.topic_type) for info in infos if info not in ours})),
            missing_s=now_s - self._seen_s,
            similar=tuple(others)[:_MAX_SHOWN],
            sent_as=in_one_line(first.name) if first and first.camera == camera_of(self.name) else "",
            remedy=self._remedy(first) if first else "",
        )

    def publisher(self) -> bytes | None:
        """Gid of the only publisher, None unless there is exactly one."""
        gids = [_gid(info) for info in self._node.get_publishers_info_by_topic(self.name)]
        return gids[0] if len(gids) == 1 else None

    def _search(self) -> list[PublishedImages]:
        """Images that the node does not receive, those of this camera first."""
        elsewhere = used_otherwise(self._camera, self._cameras())
        own = {full_name(self._node, topic) for topic in elsewhere}
        not_colour = _NOT_COLOUR - _words(self.name)
        return similar_images(
            self._node,
            self.name,
            transport=self.transport,
            usable=TOPICS,
            is_candidate=lambda name: name not in own and not _words(name) & not_colour,
        )

    def _remedy(self, images: PublishedImages) -> str:
        return remedy(self._node, images, topics=_LOCAL_NAMES, transport=self.transport, camera=self._camera)


def _words(name: str) -> set[str]:
    """The words of the name of a topic, as in camera, image and raw of /camera/image_raw."""
    return {word.lower().removesuffix("s") for word in re.split(r"[/_]", name)}


def _gid(info: TopicEndpointInfo) -> bytes:
    return bytes(info.endpoint_gid)
