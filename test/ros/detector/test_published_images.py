"""In whatever form the images of a camera are published: the node says one line to type, and it works."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Literal, cast

import pytest
import rclpy
from rclpy.node import Node
from rclpy.qos import ReliabilityPolicy

from yolov5_lifecycle.ros.detector import image_topic
from yolov5_lifecycle.ros.detector.depth import DepthInput
from yolov5_lifecycle.ros.detector.image_topic import ImageTopic, TopicStatus

Transport = Literal["raw", "compressed"]
RAW, JPEG = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
THEORA = "theora_image_transport/msg/Packet"
INSTEAD = ", in place of another remapping of ~/image_raw"
REPUBLISH = (
    "ros2 run image_transport republish --ros-args -p in_transport:={0} -p out_transport:=raw -r in/{0}:="
)


class Graph(Node):  # type: ignore[misc]  # rclpy has no types
    """A node that sees `published`, types by topic, instead of the ROS graph."""

    published: Mapping[str, str]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        return [(name, [type_name]) for name, type_name in self.published.items()]

    def get_publishers_info_by_topic(self, name: str, no_mangle: bool = False) -> list[SimpleNamespace]:
        qos = SimpleNamespace(reliability=ReliabilityPolicy.RELIABLE)
        return [
            SimpleNamespace(topic_type=type_name, qos_profile=qos, endpoint_gid=b"gid")
            for topic, type_name in self.published.items()
            if topic == name
        ]


@pytest.fixture(autouse=True)
def _graph(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image_topic, "publishers_on", Graph.get_publishers_info_by_topic)


@contextmanager
def node(published: Mapping[str, str], *words: str) -> Iterator[Graph]:
    context = rclpy.Context()
    rclpy.init(args=[], context=context)
    graph = Graph("yolov5", context=context, cli_args=[*words], enable_rosout=False)
    graph.published = published
    try:
        yield graph
    finally:
        graph.destroy_node()
        rclpy.shutdown(context=context)


def looked(
    published: Mapping[str, str], transport: Transport, words: Sequence[str] = (), *, camera: str = ""
) -> TopicStatus:
    with node(published, *words) as graph:
        return ImageTopic(graph, transport, camera=camera).look()


def remapped(name: str) -> list[str]:
    return ["--ros-args", "-r", f"~/image_raw:={name}"]


def typed(status: TopicStatus) -> list[list[str]]:
    """The words of each command in the advice."""
    return [shlex.split(line) for line in status.remedy.split("`")[1::2]]


def after(command: Sequence[str], transport: Transport, words: Sequence[str]) -> tuple[Transport, list[str]]:
    """The transport and the arguments of the node once `command` was typed."""
    if command[:3] == ["ros2", "param", "set"]:
        assert command[3:5] == ["/yolov5", "image_transport"]
        chosen = command[5]
    else:
        words = command
        chosen = next((word.partition(":=")[2] for word in words if word.startswith("image_tr")), transport)
    return cast(Transport, chosen), [*words]


@pytest.mark.parametrize("wanted", ["raw", "compressed"])
@pytest.mark.parametrize(
    "published",
    [
        pytest.param({"/cam/image": RAW}, id="raw"),
        pytest.param({"/cam/image/compressed": JPEG}, id="compressed"),
        pytest.param({"/cam/image": RAW, "/cam/image/compressed": JPEG}, id="both"),
        pytest.param({"/cam/image/compressed": RAW}, id="raw on a name that looks compressed"),
        pytest.param({"/cam/image": JPEG}, id="compressed on a name that looks raw"),
        pytest.param({"/compressed": JPEG}, id="compressed without another name"),
    ],
)
@pytest.mark.parametrize(
    "name", ["/cam/image", "/cam/image/compressed", "/cam/image/compressed/compressed", "/wrong/image", ""]
)
def test_what_is_advised_works(wanted: Transport, published: Mapping[str, str], name: str) -> None:
    words = remapped(name) if name else []
    before = looked(published, wanted, words)
    if before.publishers:
        assert typed(before) == []
        return
    (command,) = typed(before)
    transport, words = after(command, wanted, words)
    assert looked(published, transport, words).publishers == 1


@pytest.mark.parametrize(
    ("wanted", "name", "published", "advice"),
    [
        pytest.param(
            "raw",
            "/cam/image",
            {"/cam/image/compressed": JPEG, "/cam2/image": RAW},
            "type `ros2 param set /yolov5 image_transport compressed`",
            id="same camera before another",
        ),
        pytest.param(
            "raw",
            "/cam/image/compressed",
            {"/cam/image": RAW, "/cam/image/compressed": JPEG},
            f"restart the node with `--ros-args -r '~/image_raw:=/cam/image'`{INSTEAD}",
            id="wanted transport first",
        ),
        pytest.param(
            "compressed",
            "/cam/image/compressed",
            {"/cam/image/compressed": JPEG},
            f"restart the node with `--ros-args -r '~/image_raw:=/cam/image'`{INSTEAD}",
            id="appended twice",
        ),
        pytest.param(
            "raw",
            "/cam/image",
            {"/cam/image/theora": THEORA, "/cam/image/zstd": JPEG, "/cam/image/compressed": JPEG},
            "type `ros2 param set /yolov5 image_transport compressed`",
            id="what the node reads before what it cannot",
        ),
        pytest.param(
            "raw",
            "/cam/image",
            {"/cam/image/theora": THEORA},
            f"type `{REPUBLISH.format('theora')}/cam/image/theora -r out:=/cam/image`",
            id="theora",
        ),
        pytest.param(
            "compressed",
            "/cam/image/zstd",
            {"/cam/image/zstd": JPEG},
            f"type `{REPUBLISH.format('zstd')}/cam/image/zstd -r out:=/cam/image` and restart the node with "
            f"`--ros-args -r '~/image_raw:=/cam/image' -p image_transport:=raw`{INSTEAD}",
            id="zstd",
        ),
    ],
)
def test_the_nearest_form_is_advised(
    wanted: Transport, name: str, published: Mapping[str, str], advice: str
) -> None:
    status = looked(published, wanted, remapped(name))
    assert status.remedy == advice
    assert status.sent_as in published


def test_the_images_of_a_named_camera_are_advised_with_its_name() -> None:
    status = looked({"/rear/image/compressed": JPEG}, "raw", camera="rear")
    assert typed(status) == [
        shlex.split(
            "--ros-args -r '~/rear/image_raw:=/rear/image' -p rear.image_transport:=compressed",
        )
    ]
    assert (status.similar, status.sent_as) == (("/rear/image/compressed",), "")


@pytest.mark.parametrize(
    ("name", "published", "advice"),
    [
        pytest.param(
            "/d/image",
            {"/d/image/compressedDepth": JPEG, "/d/image/compressed": JPEG},
            f"type `{REPUBLISH.format('compressedDepth')}/d/image/compressedDepth -r out:=/d/image`",
            id="compressed alone",
        ),
        pytest.param(
            "/d/image/compressedDepth",
            {"/d/image/compressedDepth": JPEG, "/d/image": RAW},
            "restart the node with `--ros-args -r '~/depth/image_raw:=/d/image'`, in place of another "
            "remapping of ~/depth/image_raw",
            id="raw beside it",
        ),
        pytest.param("/d/image", {"/other/depth/image": RAW}, "", id="another camera"),
    ],
)
def test_depth_images_in_another_form_are_advised_too(
    name: str, published: Mapping[str, str], advice: str
) -> None:
    with node(published, "--ros-args", "-r", f"~/depth/image_raw:={name}") as graph:
        depth = DepthInput(graph, slop_s=0.1)
        depth.follow(is_needed=True)
        source = depth.status().image
        depth.follow(is_needed=False)
    assert source is not None
    assert (source.remedy, source.sent_as != "") == (advice, advice != "")


def test_compressed_distances_are_no_images_of_a_camera() -> None:
    status = looked({"/cam/image/compressedDepth": JPEG}, "raw", remapped("/cam/image"))
    assert (status.similar, status.remedy) == ((), "")
