"""What others send under the name of a detector neither blocks the console nor deceives it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import partial
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import State, TransitionEvent
from rcl_interfaces.msg import Log, ParameterEvent
from rclpy.duration import Duration
from rclpy.node import Node
from support.console_fixtures import ConsoleBesideNode, console_beside_node
from support.console_process import ConsoleClient, Page, address, console_process
from support.detector_process import NODE
from support.lone_node import lone_node
from support.served_node import PATIENCE_S
from support.spoofer import LATCHED, flood, managed_nodes, parameter_event
from vision_msgs.msg import LabelInfo, VisionClass

from yolov5_lifecycle.ros.console.detectors import MAX_DETECTORS

LARGE = "x" * 20_000_000
MANY = 30_000
MAX_SHOWN = 1_000_000
"""Characters of JSON."""


@pytest.fixture(scope="module")
def console() -> Iterator[ConsoleBesideNode]:
    with console_beside_node() as beside:
        yield beside


@pytest.fixture
def page(console: ConsoleBesideNode) -> Iterator[Page]:
    with console.client.page() as page:
        page.wait_for(lambda: NODE in page.nodes, "the detector")
        yield page


@pytest.fixture
def spoofer(console: ConsoleBesideNode) -> Iterator[Node]:
    with lone_node("spoofer") as node:
        yield node


def send(spoofer: Node, page: Page, topic: str, message: Any) -> None:
    """Send `message` on `topic` to all who receive it, the console among them."""
    publisher = spoofer.create_publisher(type(message), topic, LATCHED)
    page.wait_for(lambda: publisher.get_subscription_count() > 0, "the console's subscription")
    publisher.publish(message)
    assert publisher.wait_for_all_acked(Duration(seconds=PATIENCE_S))


def check_served(console: ConsoleBesideNode, page: Page, value: float) -> None:
    """Changes from the page and of somebody else are still shown."""
    assert page.set(confidence_threshold=value) == ""
    assert console.served.set(iou_threshold=value) == (True, "")
    for name in ("confidence_threshold", "iou_threshold"):
        page.wait_for(partial(is_shown, page, name, value), name)


def is_shown(page: Page, name: str, value: object) -> bool:
    return bool(page.parameter(name)["value"] == value)


LARGE_MESSAGES = {
    "event": ("/parameter_events", parameter_event(NODE, "weights", LARGE)),
    "long list": ("/parameter_events", parameter_event(NODE, "classes", [LARGE] * 3)),
    "many parameters": (
        "/parameter_events",
        ParameterEvent(node=NODE, changed_parameters=parameter_event(NODE, "a", 1).changed_parameters * MANY),
    ),
    "log": ("/rosout", Log(name="yolov5", msg=LARGE, level=Log.ERROR)),
    "logger": ("/rosout", Log(name=LARGE, msg="a")),
    "status": (
        "/diagnostics",
        DiagnosticArray(status=[DiagnosticStatus(name="yolov5: detection", hardware_id=NODE, message=LARGE)]),
    ),
    "many values": (
        "/diagnostics",
        DiagnosticArray(
            status=[
                DiagnosticStatus(
                    name="yolov5: detection", hardware_id=NODE, values=[KeyValue(key="a", value="b")] * MANY
                )
            ]
        ),
    ),
    "many classes": (f"{NODE}/label_info", LabelInfo(class_map=[VisionClass(class_name="a")] * MANY)),
    "long class": (f"{NODE}/label_info", LabelInfo(class_map=[VisionClass(class_name=LARGE)])),
    "transition": (f"{NODE}/transition_event", TransitionEvent(goal_state=State(label=LARGE))),
}


SLOW = ("many values", "many parameters", "long class", "many classes")


@pytest.mark.long
@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=pytest.mark.long if kind in SLOW else ()) for kind in LARGE_MESSAGES],
)
def test_a_message_of_any_size_is_read_within_bounds(
    console: ConsoleBesideNode, page: Page, spoofer: Node, kind: str
) -> None:
    topic, message = LARGE_MESSAGES[kind]
    send(spoofer, page, topic, message)
    check_served(console, page, round(0.3 + 0.01 * [*LARGE_MESSAGES].index(kind), 2))
    assert len(json.dumps(page.nodes[NODE])) < MAX_SHOWN


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "value"),
    [
        pytest.param("max_rate", 9.0, id="number"),
        pytest.param("cameras", ["front", "../../evil"], id="cameras"),
        pytest.param("weights", "\u202eexe.tp", id="text"),
    ],
)
def test_a_false_event_changes_nothing(
    console: ConsoleBesideNode, page: Page, spoofer: Node, name: str, value: object
) -> None:
    true = page.parameter(name)["value"]
    send(spoofer, page, "/parameter_events", parameter_event(NODE, name, value))
    check_served(console, page, 0.71)
    assert page.parameter(name)["value"] == true
    assert [camera["name"] for camera in page.nodes[NODE]["cameras"]] == [""]
    assert page.gone == []


FLOODS = {
    "events": ("/parameter_events", parameter_event(NODE, "max_rate", 9.0)),
    "events of unknown nodes": ("/parameter_events", parameter_event("/nobody", "max_rate", 9.0)),
    "transitions": (f"{NODE}/transition_event", TransitionEvent()),
    "log": ("/rosout", Log(name="yolov5", msg="a\nb" * 1000)),
    "diagnostics": (
        "/diagnostics",
        DiagnosticArray(
            status=[DiagnosticStatus(hardware_id="/nobody", values=[KeyValue(key="a", value="b")] * 1000)]
        ),
    ),
    "classes": (f"{NODE}/label_info", LabelInfo(class_map=[VisionClass(class_name="a")] * 100)),
}


@pytest.mark.parametrize("kind", FLOODS)
def test_beside_a_thousand_messages_a_second_pages_are_served(
    console: ConsoleBesideNode, page: Page, spoofer: Node, kind: str
) -> None:
    with flood(spoofer, *FLOODS[kind]):
        for value in (0.81, 0.82, 0.83):
            check_served(console, page, value)
            with console.client.page() as other:
                other.wait_for(partial(other.nodes.__contains__, NODE), "the detector")
    assert page.gone == []


@pytest.mark.long
@pytest.mark.parametrize("like_detectors", [False, True], ids=["other services", "those of detectors"])
def test_many_managed_nodes_hide_a_detector_only_if_they_look_like_one(
    console: ConsoleBesideNode, page: Page, *, like_detectors: bool
) -> None:
    names = [f"a{number:02}" for number in range(MAX_DETECTORS + 8)]
    with (
        managed_nodes(names, like_detectors=like_detectors),
        console_process(console.domain) as late,
        ConsoleClient(address(late)).page() as other,
    ):
        if like_detectors:
            other.wait_for(lambda: other.omitted.get("count", 0) >= 8, "the number of those left out")
            assert other.omitted["names"][0].startswith("/a")
        else:
            other.wait_for(lambda: NODE in other.nodes, "the detector behind the others")
            assert [*other.nodes] == [NODE]
        check_served(console, page, 0.91)
        assert page.gone == other.gone == []
