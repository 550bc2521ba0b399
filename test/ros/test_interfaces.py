"""The message types in use are those of the official vision_msgs 4.1.1 and bond."""

from __future__ import annotations

import bond.msg
import pytest
import vision_msgs.msg
from support.colcon_workspace import REPOSITORY
from support.lone_node import lone_node
from support.official_types import OFFICIAL_HASHES

TYPES = {"vision_msgs": vision_msgs.msg, "bond": bond.msg}


@pytest.mark.parametrize("package", OFFICIAL_HASHES)
def test_every_type_is_published_under_its_official_hash(ros_domain: int, package: str) -> None:
    definitions = (REPOSITORY / "interfaces" / package / "msg").glob("*.msg")
    assert {file.stem for file in definitions} == OFFICIAL_HASHES[package].keys()
    with lone_node("types") as node:
        for name, official in OFFICIAL_HASHES[package].items():
            node.create_publisher(getattr(TYPES[package], name), f"/{name}", 1)
            (endpoint,) = node.get_publishers_info_by_topic(f"/{name}")
            assert endpoint.topic_type == f"{package}/msg/{name}"
            assert str(endpoint.topic_type_hash) == official, name
