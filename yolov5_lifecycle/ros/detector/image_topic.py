"""Topics with images, in which form, and what to type so that the node receives those of a camera."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Literal

from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

from yolov5_lifecycle.printable import in_one_line, shell_command
from yolov5_lifecycle.ros.rclpy_internals import publishers_on
from yolov5_lifecycle.ros.topics import COMPRESSED_IMAGE_RAW, IMAGE_RAW, full_name, of_camera, used_otherwise
from yolov5_lifecycle.settings.suggestion import most_similar

Transport = Literal["raw", "compressed"]
TOPICS: Mapping[str, str] = {"raw": IMAGE_RAW, "compressed": COMPRESSED_IMAGE_RAW}
"""Names before remapping, by transport."""
DISCOVERY_S = 5.0
"""Time that ROS may take to discover publishers."""
_SEARCH_EVERY_S = 5.0
_LABELS = {"mask", "label", "segmentation", "semantic", "instance"}
_NOT_COLOUR = _LABELS | {"depth", "compresseddepth", "disparity"}
"""Words in the names of topics with images whose pixels are labels or distances."""
_MAX_SHOWN = 3
RAW, COMPRESSED = "raw", "compressed"
TYPE_NAMES = {RAW: "sensor_msgs/msg/Image", COMPRESSED: "sensor_msgs/msg/CompressedImage"}
_TYPES_OF_PLUGINS = {
    "theora_image_transport/msg/Packet": "theora",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": "ffmpeg",
}
_CONTENTS_OF_COMPRESSED = ("compressedDepth", "zstd")
"""Plugins of image_transport that put something else into a CompressedImage, on a topic of this name."""
_FORMS = (*TYPE_NAMES, *_TYPES_OF_PLUGINS.values(), *_CONTENTS_OF_COMPRESSED)
_MAX_CANDIDATES = 200
_MAX_ASKED = 20


@dataclass(frozen=True)
class PublishedImages:
    """A topic with images, and the transport that sends them, as image_transport calls it."""

    name: str
    form: str

    @property
    def camera(self) -> str:
        """The name that all topics with these images have in common."""
        return camera_of(self.name)


def camera_of(name: str) -> str:
    """The topic `name` without the transports at its end."""
    base, _, last = name.rpartition("/")
    return camera_of(base) if base and last in _FORMS else name


def images_on(node: Node, names: Iterable[str]) -> list[PublishedImages]:
    """The images that are published on the topics `names`."""
    return [
        PublishedImages(name, form)
        for name in names
        for form in sorted({_form(name, info.topic_type) for info in publishers_on(node, name)})
        if form
    ]


def similar_images(
    node: Node, name: str, *, transport: str, usable: Container[str], is_candidate: Callable[[str], bool]
) -> list[PublishedImages]:
    """What is published on `name`, on other topics of the same camera, and on the most similar topics.

    In this order, and of one camera first what is `usable`, best with `transport`. Without images that the
    node already receives from `name`. Asks a bounded number of topics.
    """

    def is_another(other: str) -> bool:
        return camera_of(other) != camera_of(name)

    candidates = [
        other
        for other, types in node.get_topic_names_and_types()
        if is_candidate(other) and any(_form(other, each) for each in types)
    ]
    nearest = most_similar(name, sorted(candidates, key=is_another)[:_MAX_CANDIDATES])
    found = images_on(node, sorted(nearest, key=is_another)[:_MAX_ASKED])
    return sorted(
        (images for images in found if images != PublishedImages(name, transport)),
        key=lambda images: (
            is_another(images.name),
            images.form not in usable,
            images.form != transport and not is_another(images.name),
        ),
    )


def remedy(
    node: Node, images: PublishedImages, *, topics: Mapping[str, str], transport: str, camera: str = ""
) -> str:
    """What to type so that `node` receives `images`, as a clause.

    `topics` are those of the node by transport, before remapping; `transport` is the present one. `camera`:
    see `of_camera`.
    """
    if images.form not in topics:
        return _republished(node, images, topics=topics, transport=transport, camera=camera)
    parameter = f"{camera}.image_transport" if camera else "image_transport"
    if full_name(node, of_camera(topics[images.form], camera)) == images.name:
        return f"type `ros2 param set {node.get_fully_qualified_name()} {parameter} {images.form}`"
    raw = of_camera(topics[RAW], camera)
    rule, base = raw, images.name
    if images.form == COMPRESSED:
        base = images.name.removesuffix(f"/{COMPRESSED}")
        if base in ("", images.name):
            rule, base = f"{raw}/{COMPRESSED}", images.name
    words = ["--ros-args", "-r", f"{rule}:={in_one_line(base)}"]
    if images.form != transport:
        words += ["-p", f"{parameter}:={images.form}"]
    return f"restart the node with `{shell_command(*words)}`, in place of another remapping of {raw}"


def _republished(
    node: Node, images: PublishedImages, *, topics: Mapping[str, str], transport: str, camera: str
) -> str:
    """What to type for `images` of a plugin that only image_transport has."""
    free = images.camera if images.camera != images.name else f"{images.name}/{RAW}"
    raw = PublishedImages(free, RAW)
    rules = f"in/{images.form}:={in_one_line(images.name)}", "-r", f"out:={in_one_line(free)}"
    text = (
        f"type `ros2 run image_transport republish --ros-args -p in_transport:={images.form} "
        f"-p out_transport:={RAW} -r {shell_command(*rules)}`"
    )
    if transport == RAW and full_name(node, of_camera(topics[RAW], camera)) == free:
        return text
    return f"{text} and {remedy(node, raw, topics=topics, transport=transport, camera=camera)}"


def _form(name: str, type_name: str) -> str:
    """The transport of a topic, "" if its type is none of images."""
    last = name.rpartition("/")[2]
    if type_name == TYPE_NAMES[COMPRESSED]:
        return last if last in _CONTENTS_OF_COMPRESSED else COMPRESSED
    return RAW if type_name == TYPE_NAMES[RAW] else _TYPES_OF_PLUGINS.get(type_name, "")


@dataclass(frozen=True)
class TopicStatus:
    """Publishers of the image topic in the ROS graph.

    `reliabilities`: offered by each publisher of the right type. `other_types`: types of the other
    publishers, which never match. `missing_s`: seconds without a publisher of the right type.
    `similar`: other topics with images, searched only while this topic has no such publisher. `sent_as`: the
    one that has the images of this camera in another form, "" if there is none. `remedy`: what to type to
    receive that one, else the first of `similar`.
    """

    name: str
    reliabilities: tuple[ReliabilityPolicy, ...] = ()
    other_types: tuple[str, ...] = ()
    missing_s: float = 0.0
    similar: tuple[str, ...] = ()
    sent_as: str = ""
    remedy: str = ""

    @property
    def publishers(self) -> int:
        return len(self.reliabilities)


@dataclass(eq=False)
class ImageTopic:
    """Monitors the image topic of a camera, whether or not the node subscribes to it.

    `camera`: see `of_camera`. `cameras()` returns all cameras of the node, whose topics are not suggested for
    this one. `clock` returns monotonic seconds.
    """

    node: Node
    transport: Transport
    _: KW_ONLY
    camera: str = ""
    cameras: Callable[[], Sequence[str]] = lambda: ("",)
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self.name = full_name(self.node, self.local_name)
        self._seen_s, self._searched_s = self.clock(), float("-inf")
        self._similar: list[PublishedImages] = []

    @property
    def local_name(self) -> str:
        """Name before remapping, such as ~/image_raw."""
        return of_camera(TOPICS[self.transport], self.camera)

    def follow(self, transport: Transport) -> None:
        """Switch to the topic of `transport`."""
        if transport != self.transport:
            self.transport = transport
            self._begin()

    def look(self) -> TopicStatus:
        """Query the ROS graph, which is cached in this process."""
        infos = self.node.get_publishers_info_by_topic(self.name)
        ours = [info for info in infos if info.topic_type == TYPE_NAMES[self.transport]]
        now_s = self.clock()
        if ours:
            self._seen_s, self._similar, self._searched_s = now_s, [], float("-inf")
        elif now_s - self._searched_s >= _SEARCH_EVERY_S:
            self._similar, self._searched_s = self._search(), now_s
        first = next(iter(self._similar), None)
        others = dict.fromkeys(in_one_line(each.name) for each in self._similar if each.name != self.name)
        return TopicStatus(
            name=in_one_line(self.name),
            reliabilities=tuple(info.qos_profile.reliability for info in ours),
            other_types=tuple(sorted({in_one_line(info.topic_type) for info in infos if info not in ours})),
            missing_s=now_s - self._seen_s,
            similar=tuple(others)[:_MAX_SHOWN],
            sent_as=in_one_line(first.name) if first and first.camera == camera_of(self.name) else "",
            remedy=remedy(self.node, first, topics=TOPICS, transport=self.transport, camera=self.camera)
            if first
            else "",
        )

    def publisher(self) -> bytes | None:
        """Gid of the only publisher, None unless there is exactly one."""
        infos = self.node.get_publishers_info_by_topic(self.name)
        return bytes(infos[0].endpoint_gid) if len(infos) == 1 else None

    def _search(self) -> list[PublishedImages]:
        """Images that the node does not receive, those of this camera first."""
        elsewhere = used_otherwise(self.camera, self.cameras())
        own = {full_name(self.node, topic) for topic in elsewhere}
        not_colour = _NOT_COLOUR - _words(self.name)
        return similar_images(
            self.node,
            self.name,
            transport=self.transport,
            usable=TOPICS,
            is_candidate=lambda name: name not in own and not _words(name) & not_colour,
        )


def _words(name: str) -> set[str]:
    """The words of the name of a topic, as in camera, image and raw of /camera/image_raw."""
    return {word.lower().removesuffix("s") for word in re.split(r"[/_]", name)}
