"""docs/security.md and the SROS2 policy agree with what the node does."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from fnmatch import fnmatchcase

import pytest
from rclpy.node import Node
from support.colcon_workspace import REPOSITORY
from support.preparations import Preparations
from support.served_node import ServedNode

from yolov5_lifecycle.checkpoints.archive import MAX_DIRECTORY_BYTES, MAX_RECORDS
from yolov5_lifecycle.checkpoints.locate import MAX_FILE_BYTES
from yolov5_lifecycle.checkpoints.pickle_interpreter import MAX_CALLS, MAX_OPERATIONS, MAX_PICKLE_BYTES
from yolov5_lifecycle.checkpoints.safetensors_file import MAX_HEADER_BYTES
from yolov5_lifecycle.models.class_names import MAX_NAME_LENGTH
from yolov5_lifecycle.models.model import MAX_CLASSES
from yolov5_lifecycle.process.environment import MAX_COMPRESSED_PX
from yolov5_lifecycle.ros.parameters.proposal import MAX_REASON_LENGTH
from yolov5_lifecycle.ros.parameters.settings_parameters import MAX_SUGGESTIONS
from yolov5_lifecycle.ros.parameters.values import MAX_ENTRIES
from yolov5_lifecycle.ros.services import MAX_ITEMS
from yolov5_lifecycle.ros.topics import LABEL_INFO, published, subscribed
from yolov5_lifecycle.runtimes.cache import MAX_BYTES
from yolov5_lifecycle.settings.parameter_yaml import MAX_DEPTH, MAX_SCALARS
from yolov5_lifecycle.settings.parameter_yaml import MAX_FILE_BYTES as MAX_PARAMETER_FILE_BYTES

PAGE = " ".join((REPOSITORY / "docs" / "security.md").read_text().split())
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


@pytest.mark.parametrize("right", ["publish", "subscribe"])
def test_the_page_names_every_topic_of_the_policy(right: str) -> None:
    row = PAGE.partition(f"| {right} | ")[2].partition(" |")[0]
    assert all(f"`{name.replace('/yolov5', '~')}`" in row for name in allowed("topics", right))


@pytest.mark.parametrize(
    "words",
    [
        f"more than {MAX_FILE_BYTES >> 30} GiB",
        f"more than {MAX_RECORDS:,} of them, or more than {MAX_DIRECTORY_BYTES >> 20} MiB of names and other",
        f"more than {MAX_PICKLE_BYTES >> 20} MiB, {MAX_OPERATIONS:,} operations or {MAX_CALLS:,} objects",
        f"more than {MAX_HEADER_BYTES >> 20} MiB",
        f"more than {MAX_CLASSES:,} classes",
        f"more than {MAX_NAME_LENGTH} letters",
        f"at most {MAX_COMPRESSED_PX:,} pixels",
        f"{MAX_BYTES >> 30} GiB at most",
        f"{MAX_PARAMETER_FILE_BYTES >> 20} MiB, {MAX_SCALARS:,} names and values or {MAX_DEPTH} levels",
        f"may have {MAX_ITEMS} parameters, names or prefixes, and a list in it {MAX_ENTRIES:,} entries",
        f"the first {MAX_SUGGESTIONS} unknown names, and a reason has about {MAX_REASON_LENGTH:,} characters",
    ],
)
def test_the_page_has_the_limits_of_the_code(words: str) -> None:
    assert words in PAGE
