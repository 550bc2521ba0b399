"""The message types in use are those of the official vision_msgs 4.1.1 and bond."""

from __future__ import annotations

from collections.abc import Iterator

import bond.msg
import pytest
import rclpy
import vision_msgs.msg
from rclpy.context import Context
from rclpy.node import Node
from support.colcon_workspace import REPOSITORY
from support.official_types import OFFICIAL_HASHES

TYPES = {"vision_msgs": vision_msgs.msg, "bond": bond.msg}


@pytest.fixture
def node(ros_domain: int) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context, domain_id=ros_domain)
    node = Node("types", context=context)
    yield node
    node.destroy_node()
    context.shutdown()


@pytest.mark.parametrize(
    ("package", "name", "official"),
    [
        pytest.param(package, name, official, id=f"{package}-{name}")
        for package, hashes in OFFICIAL_HASHES.items()
        for name, official in hashes.items()
    ],
)
def test_a_type_is_published_under_the_official_hash(
    node: Node, package: str, name: str, official: str
) -> None:
    node.create_publisher(getattr(TYPES[package], name), "/typed", 1)
    (endpoint,) = node.get_publishers_info_by_topic("/typed")
    assert endpoint.topic_type == f"{package}/msg/{name}"
    assert str(endpoint.topic_type_hash) == official


@pytest.mark.parametrize("package", OFFICIAL_HASHES)
def test_every_message_definition_is_compared(package: str) -> None:
    definitions = REPOSITORY / "interfaces" / package / "msg"
    assert {file.stem for file in definitions.glob("*.msg")} == OFFICIAL_HASHES[package].keys()
