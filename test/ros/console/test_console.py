"""What the installed console tells a page about detectors, does to them, and believes of others."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header
from std_srvs.srv import Trigger
from support.console_process import ConsoleClient, Page, address, closing_code, console_process
from support.detector_process import NODE
from support.lone_node import lone_node
from support.preparations import Preparations
from support.served_node import ServedNode, messages_of
from support.worker import worker_domain
from websockets.exceptions import ConnectionClosed

from yolov5_lifecycle.ros.child_process import isolated
from yolov5_lifecycle.ros.console.detectors import MAX_DETECTORS
from yolov5_lifecycle.ros.observer import PATIENCE_S
from yolov5_lifecycle.settings.settings import SETTINGS

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""Every subscription of the console accepts it."""
FIRST_LINE = "said before the console was there"


@dataclass
class ConsoleBesideNode:
    """A detector in this process with models of the test's, and an installed console of the same domain."""

    served: ServedNode
    prepare: Preparations
    domain: int
    client: ConsoleClient


@pytest.fixture(scope="module")
def console() -> Iterator[ConsoleBesideNode]:
    prepare = Preparations()
    with worker_domain() as domain, pytest.MonkeyPatch.context() as environment:
        for name, value in isolated({}, domain).items():
            environment.setenv(name, value)
        with ServedNode(prepare) as served:
            # ROS keeps the lines of a node itself for 10 s, in which a console may not have started.
            line = Log(name=NODE[1:], level=Log.INFO, msg=FIRST_LINE)
            served.client.create_publisher(Log, "/rosout", LATCHED).publish(line)
            with console_process(domain) as process:
                yield ConsoleBesideNode(served, prepare, domain, ConsoleClient(address(process)))
                process.check_running()
                assert "Traceback" not in process.output


@pytest.fixture
def page(console: ConsoleBesideNode) -> Iterator[Page]:
    """A page that shows the detector, unconfigured, with its parameters as at the start."""
    console.prepare.refusal = ""
    for state, step in (("active", "deactivate"), ("inactive", "cleanup")):
        assert console.served.state() != state or console.served.transition(step)
    with console.client.page() as page:
        page.wait_for(lambda: NODE in page.nodes, "the detector")
        page.wait_for_state("unconfigured")
        yield page


def wait_for_value(page: Page, name: str, value: object) -> None:
    page.wait_for(lambda: page.parameter(name)["value"] == value, f"{name} {value}")


def test_a_page_is_welcomed_and_told_of_each_detector_and_no_other_node(
    console: ConsoleBesideNode, page: Page
) -> None:
    with console.client.page() as late:
        assert late.welcome == {"type": "welcome", "view_only": False, "nodes": [NODE]}
    page.wait_for(lambda: FIRST_LINE in str(page.nodes[NODE]["log"]), "the log of before the console")
    node = page.nodes[NODE]
    assert node["transitions"] == ["configure", "shutdown"]
    assert [one["name"] for one in node["parameters"]] == [setting.name for setting in SETTINGS]
    assert [camera["name"] for camera in node["cameras"]] == [""]
    assert node["diagnostics"][0]["name"] == "detection"
    assert node["diagnostics"][0]["values"]["state"] == "unconfigured"


def test_metrics_have_the_figures_of_the_diagnostics(console: ConsoleBesideNode, page: Page) -> None:
    text = console.client.request("GET", "/metrics").body
    assert f'yolov5_state{{node="{NODE}",state="unconfigured"}} 1.0' in text
    assert f'yolov5_frames_total{{camera="",node="{NODE}",outcome="detected"}} 0.0' in text
    assert "yolov5_console_viewers 0.0" in text


def test_transitions_are_followed_and_change_what_is_possible(console: ConsoleBesideNode, page: Page) -> None:
    refusal = page.transition("activate")
    assert refusal == "activate is not possible while unconfigured; possible now: configure, shutdown"
    assert "not possible" in page.transition("\ud800")
    assert console.served.transition("configure")  # of somebody else
    page.wait_for_state("inactive")
    assert page.transition("activate") == ""
    assert "deactivate" in page.wait_for_state("active")["transitions"]
    page.wait_for(lambda: page.nodes[NODE]["class_names"] == ["cat", "dog"], "the names of the classes")


def test_a_refused_transition_has_the_words_of_the_node(console: ConsoleBesideNode, page: Page) -> None:
    assert page.transition("configure") == ""
    console.prepare.refusal = "the model is on holiday"
    assert "the model is on holiday" in page.transition("activate")
    page.wait_for_state("inactive")
    page.wait_for(lambda: "on holiday" in str(page.nodes[NODE]["log"]), "the line of the log")


def test_a_change_reaches_the_node_and_all_pages(console: ConsoleBesideNode, page: Page) -> None:
    values = {"confidence_threshold": 0.75, "classes": ["cat"], "regions": ["0,0.5 1,0.5 1,1 0,1"]}
    with console.client.page() as other:
        other.wait_for(lambda: NODE in other.nodes, "the detector")
        assert page.set(**values) == ""
        assert console.served.get("confidence_threshold") == 0.75
        for one in (page, other):
            for name, value in values.items():
                wait_for_value(one, name, value)
    assert page.set(confidence_threshold=0.25, classes=[], regions=[]) == ""


def test_a_refused_change_has_the_words_of_the_node_or_console_and_changes_nothing(page: Page) -> None:
    before = page.parameter("iou_threshold")["value"]
    assert "max_rate: -1.0 is not a number" in page.set(iou_threshold=0.9, max_rate=-1.0)
    assert "lazy: 'yes' is not true or false" in page.set(iou_threshold=0.9, lazy="yes")
    assert "lazy: expected true, false, a number" in page.set(iou_threshold=0.9, lazy={})
    assert page.parameter("iou_threshold")["value"] == before


def test_the_last_of_many_changes_is_what_stays(console: ConsoleBesideNode, page: Page) -> None:
    for batch in ([0.3, 0.31, 0.32, 0.33, 0.34, 0.35, 0.36], [0.4, 0.41, 0.42, 0.43, 0.44, 0.45, 0.25]):
        numbers = [page.begin(type="set", values={"confidence_threshold": value}) for value in batch]
        page.wait_for(partial(page.answers.keys().__ge__, set(numbers)), "all answers")
        assert console.served.get("confidence_threshold") == batch[-1]


def test_cameras_are_set_and_their_overrides_come_and_go(console: ConsoleBesideNode, page: Page) -> None:
    def names(kind: str) -> list[str]:
        return [one["name"] for one in page.nodes[NODE][kind]]

    assert page.set(cameras=["front", "rear"]) == ""
    page.wait_for(lambda: names("cameras") == ["front", "rear"], "the cameras")
    assert page.set(**{"front.max_rate": 5}) == ""
    page.wait_for(lambda: "front.max_rate" in names("parameters"), "the override")
    assert page.parameter("front.max_rate")["value"] == 5.0
    assert page.set(**{"front.max_rate": None}) == ""
    page.wait_for(lambda: "front.max_rate" not in names("parameters"), "no override")
    assert page.set(cameras=[]) == ""
    page.wait_for(lambda: names("cameras") == [""], "one camera without a name, as the next test expects")


@pytest.mark.long
def test_a_detector_that_ends_or_is_restarted_is_gone_and_comes_back(page: Page) -> None:
    name = "/second"
    words = ["--ros-args", "-r", "__node:=second"]
    with ServedNode(Preparations(), arguments=words):
        page.wait_for(lambda: name in page.nodes, "the second detector")
        with ServedNode(Preparations(), arguments=words):  # before the first is missed
            page.wait_for(lambda: name in page.gone and name in page.nodes, "its new process")
    page.wait_for(lambda: name not in page.nodes, "the end of both")
    lost = page.lost[name]
    assert (lost["state"], lost["log"]) != ("", [])
    assert page.ask(type="transition", node=name, label="configure") == f"there is no detector {name}"
    with ServedNode(Preparations(), arguments=[*words, "-p", "max_rate:=3.0"]):
        page.wait_for(lambda: name in page.nodes, "the new detector")
        page.wait_for(
            lambda: str(page.nodes[name]["log"]).count("next step") == 3, "the log of all processes"
        )
        assert page.parameter("max_rate", name)["value"] == 3.0
        assert page.ask(type="transition", node=name, label="configure") == ""
    page.wait_for(lambda: name not in page.nodes, "its end, too: the next test begins without it")


class JpegPublisher:
    """Publishes compressed images as a detector does, stamped 1.5 s, 2.5 s and so on."""

    def __init__(self, node: Node, topic: str) -> None:
        self._publisher = node.create_publisher(CompressedImage, topic, QoSProfile(depth=1))
        self.close = partial(node.destroy_publisher, self._publisher)
        self._count = 0

    @property
    def subscribers(self) -> int:
        return int(self._publisher.get_subscription_count())

    def publish(self, size: int = 100) -> None:
        """The next image, of so many bytes."""
        self._count += 1
        header = Header()
        header.stamp.sec, header.stamp.nanosec = self._count, 500_000_000
        self._publisher.publish(CompressedImage(header=header, format="jpeg", data=bytes(size)))


@pytest.fixture
def images(console: ConsoleBesideNode, page: Page) -> Iterator[JpegPublisher]:
    """The annotated images of the detector, which is unconfigured and so publishes none itself."""
    publisher = JpegPublisher(console.served.client, f"{NODE}/image/compressed")
    assert publisher.subscribers == 0
    yield publisher
    # Nobody looks any more; else the next test takes a leaving subscriber for its own.
    wait_for_subscribers(console, publisher, 0)
    publisher.close()


def wait_for_subscribers(console: ConsoleBesideNode, images: JpegPublisher, count: int) -> None:
    console.served.wait_for(lambda: images.subscribers == count, f"{count} subscribers")


def test_all_viewers_share_a_subscription_and_begin_with_the_newest_image(
    console: ConsoleBesideNode, images: JpegPublisher
) -> None:
    with console.client.viewer() as first:
        wait_for_subscribers(console, images, 1)
        images.publish(1234)
        assert first.receive() == (1.5, bytes(1234))
        with console.client.viewer() as second:
            assert second.receive() == (1.5, bytes(1234))
        assert images.subscribers == 1


def test_a_stalled_viewer_delays_nobody_and_gets_only_the_newest_image_after_its_last(
    console: ConsoleBesideNode, images: JpegPublisher
) -> None:
    large = 200_000  # bytes that the buffers of a connection do not swallow many times
    with console.client.viewer() as stalled, console.client.viewer() as quick:
        wait_for_subscribers(console, images, 1)
        images.publish(large)
        assert quick.receive()[0] == 1.5
        for number in range(2, 60):
            quick.take()
            images.publish(large)
            assert quick.receive()[0] == number + 0.5
        assert stalled.receive()[0] == 1.5
        stalled.take()
        assert stalled.receive()[0] == 59.5
        with pytest.raises(TimeoutError):
            stalled.receive(0.1)


@pytest.mark.long
def test_of_many_nodes_each_camera_has_its_own_images_and_those_that_are_asked_for_are_shown(
    console: ConsoleBesideNode, page: Page
) -> None:
    name = "/robot/eyes"
    words = ["--ros-args", "-r", "__node:=eyes", "-r", "__ns:=/robot", "-p", "cameras:=[front, rear]"]
    with (
        ServedNode(Preparations(), arguments=words) as served,
        console_process(console.domain, "--node", name) as process,
        ConsoleClient(address(process)).page() as chosen,
    ):
        for one in (page, chosen):
            one.wait_for(partial(one.nodes.__contains__, name), "the second detector")
        assert [*chosen.nodes] == [name]
        front, rear = (
            JpegPublisher(served.client, f"{name}/{camera}/image/compressed") for camera in ("front", "rear")
        )
        with console.client.viewer(name, "front") as ahead, console.client.viewer(name, "rear") as behind:
            served.wait_for(lambda: front.subscribers == rear.subscribers == 1, "the subscriptions")
            rear.publish(7)
            front.publish(5)
            assert (ahead.receive(), behind.receive()) == ((1.5, bytes(5)), (1.5, bytes(7)))
        assert page.ask(type="transition", node=name, label="configure") == ""
        page.wait_for_state("inactive", name)
        assert page.nodes[NODE]["state"] == "unconfigured"
    page.wait_for(lambda: name in page.gone, "the end of the second detector")


@pytest.mark.parametrize(
    ("node", "camera", "word", "code"),
    [
        pytest.param("/nobody", "", "taken", 4404, id="node"),
        pytest.param(NODE, "front", "taken", 4404, id="camera"),
        pytest.param(NODE, "", "more", 1008, id="another word than taken"),
        pytest.param(NODE, "", "taken", 1008, id="taken without an image"),
    ],
)
def test_a_viewer_that_asks_for_something_else_is_closed(
    console: ConsoleBesideNode, page: Page, node: str, camera: str, word: str, code: int
) -> None:
    with console.client.viewer(node, camera) as viewer:
        with suppress(ConnectionClosed):
            viewer.connection.send(word)
        assert closing_code(viewer.connection) == code


EVENT = ParameterEvent(node=NODE, changed_parameters=messages_of(max_rate=9.0))
STATUS = DiagnosticStatus(
    name="yolov5: detection", hardware_id="/x", values=[KeyValue(key="a", value="b")] * 1000
)
FLOODS = {
    "events": ("/parameter_events", EVENT),
    "log": ("/rosout", Log(name="yolov5", msg="a\nb" * 1000)),
    "diagnostics": ("/diagnostics", DiagnosticArray(status=[STATUS])),
}


@pytest.fixture
def spoofer(console: ConsoleBesideNode) -> Iterator[Node]:
    """A node that sends under the names of others."""
    with lone_node("spoofer") as node:
        yield node


def check_served(console: ConsoleBesideNode, page: Page, value: float) -> None:
    """Changes from the page and of somebody else are still shown."""
    assert page.set(confidence_threshold=value) == ""
    assert console.served.set(iou_threshold=value) == (True, "")
    for name in ("confidence_threshold", "iou_threshold"):
        wait_for_value(page, name, value)


@pytest.mark.parametrize(("topic", "message"), FLOODS.values(), ids=FLOODS)
def test_beside_a_thousand_false_messages_a_second_pages_are_served_and_show_the_truth(
    console: ConsoleBesideNode, page: Page, spoofer: Node, topic: str, message: Any
) -> None:
    publisher = spoofer.create_publisher(type(message), topic, LATCHED)
    is_over = threading.Event()

    def send() -> None:
        while not is_over.wait(0.001):
            publisher.publish(message)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        for value in (0.81, 0.82):
            check_served(console, page, value)
            with console.client.page() as other:
                other.wait_for(partial(other.nodes.__contains__, NODE), "the detector")
    finally:
        is_over.set()
        thread.join()
    assert page.parameter("max_rate")["value"] == 0.0
    assert page.gone == []


@pytest.mark.long
def test_many_managed_nodes_hide_a_detector_only_if_they_look_like_one(
    console: ConsoleBesideNode, page: Page
) -> None:
    kinds = {
        "get_state": GetState,
        "change_state": ChangeState,
        "get_available_transitions": GetAvailableTransitions,
    }
    with ExitStack() as stack:
        context = stack.enter_context(lone_node("crowd")).context

        def join(initial: str, services: dict[str, Any]) -> None:
            for number in range(MAX_DETECTORS + 8):
                node = rclpy.create_node(f"{initial}{number:02}", context=context)
                stack.callback(node.destroy_node)
                node.create_publisher(DiagnosticArray, "/diagnostics", 10)
                for service, kind in services.items():
                    node.create_service(kind, f"~/{service}", lambda _, answer: answer)

        join("a", kinds)
        process = stack.enter_context(console_process(console.domain))
        other = stack.enter_context(ConsoleClient(address(process)).page())
        other.wait_for(lambda: NODE in other.nodes, "the detector behind the others")
        join("b", kinds | {"collect": Trigger})
        process.wait_for_output("further nodes are left out, /b", PATIENCE_S)
        check_served(console, page, 0.91)
        assert [*other.nodes] == [NODE]
        assert page.gone == other.gone == []
