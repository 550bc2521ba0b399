"""Topics of a camera in the ROS graph: who publishes there, and what to type if the images are elsewhere."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import KW_ONLY, dataclass
from typing import Literal, NamedTuple

from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from yolov5_lifecycle.printable import in_one_line, shell_command
from yolov5_lifecycle.ros.rclpy_internals import publishers_on
from yolov5_lifecycle.ros.topics import (
    COMPRESSED_IMAGE_RAW,
    DEPTH_CAMERA_INFO,
    DEPTH_IMAGE_RAW,
    IMAGE_RAW,
    full_name,
    of_camera,
    published,
    subscribed,
)
from yolov5_lifecycle.settings.suggestion import most_similar

Transport = Literal["raw", "compressed"]
RAW, COMPRESSED, CAMERA_INFO = "raw", "compressed", "camera_info"
MESSAGE_TYPES: Mapping[str, type] = {RAW: Image, COMPRESSED: CompressedImage, CAMERA_INFO: CameraInfo}
DISCOVERY_S = 5.0
"""Time that ROS may take to discover publishers."""
_SEARCH_EVERY_S = 5.0
_LABELS = {"mask", "label", "segmentation", "semantic", "instance"}
_NOT_COLOUR = _LABELS | {"depth", "compresseddepth", "disparity"}
"""Words in the names of topics with images whose pixels are labels or distances."""
_MAX_SHOWN = 3
_MAX_CANDIDATES = 200
_MAX_ASKED = 20
_FORMS_OF_TYPES = {
    "sensor_msgs/msg/Image": RAW,
    "sensor_msgs/msg/CompressedImage": COMPRESSED,
    "theora_image_transport/msg/Packet": "theora",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": "ffmpeg",
}
_CONTENTS_OF_COMPRESSED = ("compressedDepth", "zstd")
"""Plugins of image_transport that put something else into a CompressedImage, on a topic of this name."""
_FORMS = (*_FORMS_OF_TYPES.values(), *_CONTENTS_OF_COMPRESSED)


class PublishedImages(NamedTuple):
    """A topic with images, and the transport that sends them, as image_transport calls it."""

    name: str
    form: str


@dataclass(frozen=True)
class TopicStatus:
    """Publishers of a topic in the ROS graph.

    `offers`: QoS of each publisher of the right type. `other_types`: types of the other publishers, which
    never match. `missing_s`: seconds without a publisher of the right type.
    `similar`: other topics with images, searched only while this topic has no such publisher. `sent_as`: the
    one that has the images of this camera in another form, "" if there is none. `remedy`: what to type to
    receive that one, else the first of `similar`.
    """

    name: str
    offers: tuple[QoSProfile, ...] = ()
    other_types: tuple[str, ...] = ()
    missing_s: float = 0.0
    similar: tuple[str, ...] = ()
    sent_as: str = ""
    remedy: str = ""

    @property
    def publishers(self) -> int:
        return len(self.offers)


@dataclass(eq=False)
class CameraTopic:
    """Monitors a topic of a camera, whether or not the node subscribes to it.

    `topics` are those of the node by transport, before remapping and without the name of the `camera` (see
    `of_camera`); `form` is the transport of this one. `cameras()` returns all cameras of the node, whose
    topics are not suggested for this one, nor are those with a word of `unlike` that this one lacks. `clock`
    returns monotonic seconds.
    """

    node: Node
    topics: Mapping[str, str]
    form: str
    _: KW_ONLY
    camera: str = ""
    cameras: Callable[[], Sequence[str]] = lambda: ("",)
    unlike: Set[str] = frozenset()
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self._local_names = {form: of_camera(topic, self.camera) for form, topic in self.topics.items()}
        self.local_name = self._local_names[self.form]
        """Name before remapping, such as ~/image_raw."""
        self.name = full_name(self.node, self.local_name)
        self.message_type = MESSAGE_TYPES[self.form]
        self._seen_s, self._searched_s = self.clock(), float("-inf")
        self._similar: list[PublishedImages] = []

    def look(self) -> TopicStatus:
        """Query the ROS graph, which is cached in this process."""
        type_name = f"sensor_msgs/msg/{self.message_type.__name__}"
        infos = publishers_on(self.node, self.name)
        offers = tuple(info.qos_profile for info in infos if info.topic_type == type_name)
        now_s = self.clock()
        if offers:
            self._seen_s, self._similar, self._searched_s = now_s, [], float("-inf")
        elif now_s - self._searched_s >= _SEARCH_EVERY_S and RAW in self.topics:
            self._similar, self._searched_s = self._search(), now_s
        first = next(iter(self._similar), None)
        others = dict.fromkeys(in_one_line(each.name) for each in self._similar if each.name != self.name)
        return TopicStatus(
            name=in_one_line(self.name),
            offers=offers,
            other_types=tuple(sorted({in_one_line(info.topic_type) for info in infos} - {type_name})),
            missing_s=now_s - self._seen_s,
            similar=tuple(others)[:_MAX_SHOWN],
            sent_as=in_one_line(first.name) if first and not self._is_of_another(first.name) else "",
            remedy=self._remedy(first) if first else "",
        )

    def only_publisher(self) -> bytes | None:
        """Gid of the only publisher, None unless there is exactly one."""
        infos = publishers_on(self.node, self.name)
        return bytes(infos[0].endpoint_gid) if len(infos) == 1 else None

    def _search(self) -> list[PublishedImages]:
        """Images that the node does not receive: of this camera, then on the most similar topics.

        Of one camera first those that the node can receive, best with the present transport. Asks a bounded
        number of topics.
        """
        cameras = self.cameras()
        own = {full_name(self.node, topic) for topic in (*published(cameras), *subscribed(cameras))}
        own -= {full_name(self.node, topic) for topic in self._local_names.values()}
        unlike = self.unlike - _words(self.name)
        candidates = [
            name
            for name, types in self.node.get_topic_names_and_types()
            if name not in own and not _words(name) & unlike and any(_form(name, each) for each in types)
        ]
        nearest = most_similar(self.name, sorted(candidates, key=self._is_of_another)[:_MAX_CANDIDATES])
        found = [
            PublishedImages(name, form)
            for name in sorted(nearest, key=self._is_of_another)[:_MAX_ASKED]
            for form in sorted({_form(name, info.topic_type) for info in publishers_on(self.node, name)})
            if form and (name, form) != (self.name, self.form)
        ]
        return sorted(found, key=self._rank)

    def _is_of_another(self, name: str) -> bool:
        return _camera_of(name) != _camera_of(self.name)

    def _rank(self, images: PublishedImages) -> tuple[bool, bool, bool]:
        is_of_another = self._is_of_another(images.name)
        if images.form not in self.topics:
            return is_of_another, True, images.form == COMPRESSED  # JPEG cannot hold distances
        return is_of_another, False, images.form != self.form and not is_of_another

    def _remedy(self, images: PublishedImages) -> str:
        """What to type so that the node receives `images`, as a clause."""
        if images.form not in self.topics:
            return self._republished(images)
        parameter = f"{self.camera}.image_transport" if self.camera else "image_transport"
        if full_name(self.node, self._local_names[images.form]) == images.name:
            return f"type `ros2 param set {self.node.get_fully_qualified_name()} {parameter} {images.form}`"
        raw = self._local_names[RAW]
        rule, base = raw, images.name
        if images.form == COMPRESSED:
            base = images.name.removesuffix(f"/{COMPRESSED}")
            if base in ("", images.name):
                rule, base = f"{raw}/{COMPRESSED}", images.name
        words = ["--ros-args", "-r", f"{rule}:={in_one_line(base)}"]
        if images.form != self.form:
            words += ["-p", f"{parameter}:={images.form}"]
        return f"restart the node with `{shell_command(*words)}`, in place of another remapping of {raw}"

    def _republished(self, images: PublishedImages) -> str:
        """What to type for `images` of a plugin that only image_transport has."""
        camera = _camera_of(images.name)
        free = camera if camera != images.name else f"{images.name}/{RAW}"
        rules = f"in/{images.form}:={in_one_line(images.name)}", "-r", f"out:={in_one_line(free)}"
        text = (
            f"type `ros2 run image_transport republish --ros-args -p in_transport:={images.form} "
            f"-p out_transport:={RAW} -r {shell_command(*rules)}`"
        )
        if self.form == RAW and self.name == free:
            return text
        return f"{text} and {self._remedy(PublishedImages(free, RAW))}"


def colour_topic(
    node: Node,
    transport: str,
    *,
    camera: str = "",
    cameras: Callable[[], Sequence[str]] = lambda: ("",),
    clock: Callable[[], float] = time.monotonic,
) -> CameraTopic:
    """The topic with the colour images of a camera."""
    topics = {RAW: IMAGE_RAW, COMPRESSED: COMPRESSED_IMAGE_RAW}
    return CameraTopic(
        node, topics, transport, camera=camera, cameras=cameras, unlike=_NOT_COLOUR, clock=clock
    )


def depth_topics(node: Node, camera: str) -> tuple[CameraTopic, CameraTopic]:
    """The topics with the depth images of a camera and with their camera_info."""
    return (
        CameraTopic(node, {RAW: DEPTH_IMAGE_RAW}, RAW, camera=camera),
        CameraTopic(node, {CAMERA_INFO: DEPTH_CAMERA_INFO}, CAMERA_INFO, camera=camera),
    )


def _camera_of(name: str) -> str:
    """The topic `name` without the transports at its end, which all topics with these images have."""
    base, _, last = name.rpartition("/")
    return _camera_of(base) if base and last in _FORMS else name


def _form(name: str, type_name: str) -> str:
    """The transport of a topic, "" if its type is none of images."""
    last, form = name.rpartition("/")[2], _FORMS_OF_TYPES.get(type_name, "")
    return last if form == COMPRESSED and last in _CONTENTS_OF_COMPRESSED else form


def _words(name: str) -> set[str]:
    """The words of the name of a topic, as in camera, image and raw of /camera/image_raw."""
    return {word.lower().removesuffix("s") for word in re.split(r"[/_]", name)}
