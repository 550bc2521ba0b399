"""Topics on which images are published, in which form, and what to type so that the node receives them."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass

from rclpy.node import Node

from yolov5_lifecycle.printable import in_one_line, shell_command
from yolov5_lifecycle.ros.rclpy_internals import publishers_on
from yolov5_lifecycle.ros.topics import full_name, of_camera
from yolov5_lifecycle.settings.suggestion import most_similar

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
    rules = f"in/{images.form}:={in_one_line(images.name)}", f"out:={in_one_line(free)}"
    words = [
        *("ros2", "run", "image_transport", "republish", "--ros-args"),
        *(
            "-p",
            f"in_transport:={images.form}",
            "-p",
            f"out_transport:={RAW}",
            "-r",
            rules[0],
            "-r",
            rules[1],
        ),
    ]
    text = f"type `{shell_command(*words)}`"
    if transport == RAW and full_name(node, of_camera(topics[RAW], camera)) == free:
        return text
    return f"{text} and {remedy(node, raw, topics=topics, transport=transport, camera=camera)}"


def _form(name: str, type_name: str) -> str:
    """The transport of a topic, "" if its type is none of images."""
    last = name.rpartition("/")[2]
    if type_name == TYPE_NAMES[COMPRESSED]:
        return last if last in _CONTENTS_OF_COMPRESSED else COMPRESSED
    return RAW if type_name == TYPE_NAMES[RAW] else _TYPES_OF_PLUGINS.get(type_name, "")
