"""The SROS2 policy allows what the node does, and nothing more."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from fnmatch import fnmatchcase

import pytest
from rclpy.node import Node
from support.colcon_workspace import REPOSITORY
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.ros.topics import LABEL_INFO, published, subscribed

POLICY = ElementTree.parse(REPOSITORY / "config" / "security_policy.xml")


def allowed(kind: str, right: str) -> set[str]:
    """The full names of what the policy allows the node /yolov5."""
    (profile,) = POLICY.iter("profile")
    assert profile.attrib == {"ns": "/", "node": "yolov5"}
    names = [name.text or "" for group in profile.iter(kind) if group.get(right) == "ALLOW" for name in group]
    return {name.replace("~", "/yolov5") for name in names}


def fits(names: set[str], patterns: set[str]) -> bool:
    """Whether each of `names` matches one of `patterns`, and none of these is left over."""
    matching = {name: {pattern for pattern in patterns if fnmatchcase(name, pattern)} for name in names}
    return all(matching.values()) and set().union(*matching.values()) == patterns


def used(client: Node) -> dict[tuple[str, str], set[str]]:
    """The names in the graph of what the node /yolov5 does."""
    found = {
        ("topics", "publish"): client.get_publisher_names_and_types_by_node("yolov5", "/"),
        ("topics", "subscribe"): client.get_subscriber_names_and_types_by_node("yolov5", "/"),
        ("services", "reply"): client.get_service_names_and_types_by_node("yolov5", "/"),
    }
    return {key: {name for name, _ in named} for key, named in found.items()}


@pytest.mark.parametrize(
    ("cameras", "whose"), [("[]", ""), ("[front, rear]", "*/")], ids=["no name", "two names"]
)
def test_the_policy_allows_what_the_node_uses_and_nothing_more(
    ros_domain: int, cameras: str, whose: str
) -> None:
    of_cameras = {name for name in published(("*",)) + subscribed(("*",)) if name != LABEL_INFO}
    of_others = {*published(("",)), *subscribed(("",))} - {LABEL_INFO} if whose else of_cameras
    other_topics = {name.replace("~", "/yolov5") for name in of_others}

    def agrees(unused: str) -> bool:
        absent = {*other_topics, f"/yolov5/{whose}{unused}"}
        return all(fits(names, allowed(*key) - absent) for key, names in used(served.client).items())

    parameters = ["use_sim_time:=true", "depth:=true", "lazy:=false", f"cameras:={cameras}"]
    with ServedNode(Preparations(), parameters=parameters) as served:
        served.bring_to("active")
        served.wait_for(lambda: agrees("image_raw/compressed"), "the names of the policy")
        assert served.set(image_transport="compressed") == (True, "")
        served.wait_for(lambda: agrees("image_raw"), "the names of the policy")
