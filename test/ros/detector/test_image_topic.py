"""Where images are expected: wrong remappings are refused or explained with one line to type that works."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from itertools import product
from types import SimpleNamespace
from typing import Literal, cast

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage, Image
from std_msgs.msg import String
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.detector import camera_topic
from yolov5_lifecycle.ros.detector.camera_topic import TopicStatus, colour_topic
from yolov5_lifecycle.ros.detector.depth import DepthInput
from yolov5_lifecycle.ros.observer import Observer

# The node


@pytest.mark.parametrize(
    ("rules", "told"),
    [
        pytest.param(
            ["~/image_raw:=/yolov5/detections"], "~/detections and ~/image_raw", id="input-is-output"
        ),
        pytest.param(["~/image_raw:=/diagnostics"], "~/image_raw and /diagnostics", id="diagnostics"),
        pytest.param(
            ["~/detections:=/yolov5/image_raw/compressed"],
            "~/detections and ~/image_raw/compressed",
            id="other-form",
        ),
        pytest.param(
            ["~/left/image:=/seen", "~/right/image:=/seen"],
            "~/left/image and ~/right/image",
            id="two-cameras",
        ),
    ],
)
def test_configure_refuses_topics_that_are_remapped_to_one_and_tells_wrong_qos_overrides_too(
    prepare: Preparations, rules: list[str], told: str
) -> None:
    remapping = (word for rule in rules for word in ("-r", rule))
    arguments = ["--ros-args", *remapping, "-p", "qos_overrides.x.y:=2"]
    cameras = ["cameras:=[left, right]"] if len(rules) > 1 else []
    with ServedNode(prepare, parameters=cameras, arguments=arguments) as served:
        assert not served.transition("configure")
        assert served.state() == "unconfigured"
        status = served.status()
        assert status.level == DiagnosticStatus.ERROR
        assert f"{told} are remapped to the same topic" in status.message
        assert "qos_overrides.x.y: this node has no such topic or policy." in status.message


# What is in the ROS graph


@pytest.fixture
def node(ros_domain: int) -> Iterator[Observer]:
    with closing(Observer("viewer", domain=ros_domain)) as node:
        yield node


def test_the_time_without_a_publisher_of_the_right_type_grows_until_one_is_there(node: Observer) -> None:
    now_s = 100.0
    topic = colour_topic(node, "raw", clock=lambda: now_s)
    assert topic.look().missing_s == 0.0
    now_s = 103.0
    assert topic.look().missing_s == 3.0
    publisher = node.create_publisher(Image, "/viewer/image_raw", QoSProfile(depth=1))
    node.wait_for(lambda: topic.look().publishers == 1, "the publisher")
    assert topic.look().missing_s == 0.0
    node.destroy_publisher(publisher)
    with closing(Observer("other", domain=int(node.context.get_domain_id()))) as other:
        other.create_publisher(String, "/viewer/image_raw", 1)
        node.wait_for(lambda: topic.look().other_types == ("std_msgs/msg/String",), "the other type")
        now_s = 104.0
        assert (topic.look().publishers, topic.look().missing_s) == (0, 1.0)


def test_topics_with_images_are_searched_seldom_and_only_those_with_publishers_are_named(
    node: Observer,
) -> None:
    now_s = 0.0
    topic = colour_topic(node, "raw", clock=lambda: now_s)
    node.create_subscription(Image, "/viewer/image_row", lambda _: None, 1)
    node.create_publisher(Image, "/viewer/image", 1)  # where the node itself publishes
    assert topic.look().similar == ()
    for number in range(5):
        node.create_publisher(Image, f"/viewer/{'x' * number}image_raw_{number}", 1)
    node.create_publisher(CompressedImage, "/viewer/image_raw/compressed", 1)
    node.wait_for(lambda: node.count_publishers("/viewer/image_raw/compressed") == 1, "the publisher")
    assert topic.look().similar == ()
    now_s = 5.0
    similar = topic.look().similar
    assert similar[:2] == ("/viewer/image_raw/compressed", "/viewer/image_raw_0")  # the same camera first
    assert len(similar) == 3
    assert not {"/viewer/image", "/viewer/image_row"} & set(similar)


Transport = Literal["raw", "compressed"]
RAW, JPEG = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
THEORA = "theora_image_transport/msg/Packet"
INSTEAD = ", in place of another remapping of ~/image_raw"
REPUBLISH = (
    "ros2 run image_transport republish --ros-args -p in_transport:={0} -p out_transport:=raw -r in/{0}:="
)


class Graph(Node):  # type: ignore[misc]  # rclpy has no types
    """A node that sees `published`, types by topic, instead of the ROS graph."""

    def __init__(self, published: Mapping[str, str], words: Sequence[str], context: rclpy.Context) -> None:
        self.published: Mapping[str, str] = {}
        super().__init__("yolov5", context=context, cli_args=[*words], enable_rosout=False)
        self.published = published

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        return [(name, [type_name]) for name, type_name in self.published.items()]

    def get_publishers_info_by_topic(self, name: str, no_mangle: bool = False) -> list[SimpleNamespace]:
        qos = SimpleNamespace(reliability=ReliabilityPolicy.RELIABLE)
        return [
            SimpleNamespace(topic_type=type_name, qos_profile=qos)
            for topic, type_name in self.published.items()
            if topic == name
        ]


class Looker:
    """Looks at topics with graphs of the test's."""

    def __init__(self) -> None:
        self.context = rclpy.Context()
        rclpy.init(args=[], context=self.context)

    def look(
        self, published: Mapping[str, str], transport: Transport, name: str = "", words: Sequence[str] = ()
    ) -> TopicStatus:
        """What is said of a camera whose ~/image_raw is remapped to `name`, or started with `words`."""
        node = Graph(published, words or (remapped(name) if name else []), self.context)
        status = colour_topic(node, transport).look()
        node.destroy_node()
        return status


@pytest.fixture
def looker(monkeypatch: pytest.MonkeyPatch) -> Iterator[Looker]:
    monkeypatch.setattr(camera_topic, "publishers_on", Graph.get_publishers_info_by_topic)
    looker = Looker()
    yield looker
    rclpy.shutdown(context=looker.context)


def remapped(name: str) -> list[str]:
    return ["--ros-args", "-r", f"~/image_raw:={name}"]


def typed(status: TopicStatus) -> list[list[str]]:
    """The words of each command in the advice."""
    return [shlex.split(line) for line in status.remedy.split("`")[1::2]]


def after(command: Sequence[str], transport: Transport, name: str) -> tuple[Transport, list[str]]:
    """The transport and the arguments of the node once `command` was typed."""
    if command[:3] == ["ros2", "param", "set"]:
        assert command[3:5] == ["/yolov5", "image_transport"]
        return cast(Transport, command[5]), remapped(name) if name else []
    chosen = next((word.partition(":=")[2] for word in command if word.startswith("image_tr")), transport)
    return cast(Transport, chosen), [*command]


@pytest.mark.parametrize(
    "published",
    [
        pytest.param({"/cam/image": RAW, "/cam/image/compressed": JPEG}, id="both"),
        pytest.param({"/cam/image/compressed": JPEG}, id="compressed"),
        pytest.param({"/cam/image/compressed": RAW}, id="raw on a name that looks compressed"),
        pytest.param({"/cam/image": JPEG}, id="compressed on a name that looks raw"),
        pytest.param({"/compressed": JPEG}, id="compressed without another name"),
    ],
)
def test_what_is_advised_works(looker: Looker, published: Mapping[str, str]) -> None:
    names = ("/cam/image", "/cam/image/compressed", "/cam/image/compressed/compressed", "/wrong/image", "")
    transports: tuple[Transport, ...] = ("raw", "compressed")
    for wanted, name in product(transports, names):
        before = looker.look(published, wanted, name)
        if before.publishers:
            assert typed(before) == []
            continue
        (command,) = typed(before)
        transport, words = after(command, wanted, name)
        assert looker.look(published, transport, words=words).publishers == 1, (wanted, name)


@pytest.mark.parametrize(
    ("wanted", "name", "published", "advice"),
    [
        pytest.param(
            "raw",
            "/cam/image",
            {
                "/cam2/image": RAW,
                "/cam/image/theora": THEORA,
                "/cam/image/zstd": JPEG,
                "/cam/image/compressed": JPEG,
            },
            "type `ros2 param set /yolov5 image_transport compressed`",
            id="same camera before another, what the node reads before what it cannot",
        ),
        pytest.param(
            "raw",
            "/cam/image/compressed",
            {"/cam/image": RAW, "/cam/image/compressed": JPEG},
            f"restart the node with `--ros-args -r '~/image_raw:=/cam/image'`{INSTEAD}",
            id="wanted transport first",
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
    looker: Looker, wanted: Transport, name: str, published: Mapping[str, str], advice: str
) -> None:
    status = looker.look(published, wanted, name)
    assert status.remedy == advice
    assert status.sent_as in published


def test_the_images_of_a_named_camera_are_advised_with_its_name(looker: Looker) -> None:
    node = Graph({"/rear/image/compressed": JPEG}, [], looker.context)
    status = colour_topic(node, "raw", camera="rear").look()
    words = "--ros-args -r '~/rear/image_raw:=/rear/image' -p rear.image_transport:=compressed"
    assert typed(status) == [shlex.split(words)]
    assert (status.similar, status.sent_as) == (("/rear/image/compressed",), "")
    node.destroy_node()


@pytest.mark.parametrize("transport", ["raw", "compressed"])
def test_images_of_labels_and_distances_are_offered_only_where_such_are_expected(
    looker: Looker, transport: Transport
) -> None:
    names = ("masks", "label_image", "segmentation/image_raw", "depth/image_raw")
    published = dict.fromkeys([f"/other/{name}" for name in (*names, "labelled_image")], RAW)
    assert looker.look(published, transport, "/cam/image").similar == ("/other/labelled_image",)
    assert looker.look({"/other/labels": RAW}, transport, "/cam/labels").similar == ("/other/labels",)
    distances = looker.look({"/cam/image/compressedDepth": JPEG}, transport, "/cam/image")
    assert (distances.similar, distances.remedy) == ((), "")


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
    looker: Looker, name: str, published: Mapping[str, str], advice: str
) -> None:
    node = Graph(published, ["--ros-args", "-r", f"~/depth/image_raw:={name}"], looker.context)
    depth = DepthInput(node, slop_s=0.1)
    depth.follow(is_needed=True)
    source = depth._subscriptions[0].topic.look()
    depth.follow(is_needed=False)
    node.destroy_node()
    assert (source.remedy if source.sent_as else "") == advice
