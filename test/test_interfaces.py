"""The message types in use are those of the official vision_msgs 4.1.1."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rclpy
from colcon_workspace import REPOSITORY
from rclpy.context import Context
from rclpy.node import Node
from vision_msgs import msg

# A type's hash covers its name and its fields' names, types and order, through all nested types.
OFFICIAL_HASHES = {
    "BoundingBox2D": "RIHS01_008eacbb0cf8f26e83795547bed013eec3675485ef386ec056d80eaaf1c1ce2f",
    "Detection2D": "RIHS01_0d12b69df5c593b3455b7346fac8205437a7d4bcb09b9e0e0b2dde787ded38ea",
    "Detection2DArray": "RIHS01_214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968",
    "LabelInfo": "RIHS01_3d37df4015cdf660cc851c51897f2acd957e1ca6205ba0a99aebffb9406b0783",
    "ObjectHypothesis": "RIHS01_51da43cec11c01957a64d1e05a24acd18aae7745ec30b74348ad5f6d634f7f90",
    "ObjectHypothesisWithPose": "RIHS01_41c12344c0396c48b81df12467c192d99b2a0eb1463c5c37194e4223251c80bc",
    "Point2D": "RIHS01_eab0e83f44ab4de92ceaf76dd7d0e7638f2bdd1d16ffbe16c7a136c48e407247",
    "Pose2D": "RIHS01_b0b5d1d7b4c20dd4fcde3ed1d4b289a919290572007d67a97043814db25d3648",
    "VisionClass": "RIHS01_1e4a11f0fed50b5623cb8ff26ca0e37952a48a9c074d16f804b44e9164c2037a",
}


@pytest.fixture
def node(ros_domain: int) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context, domain_id=ros_domain)
    node = Node("types", context=context)
    yield node
    node.destroy_node()
    context.shutdown()


@pytest.mark.parametrize(("name", "official"), OFFICIAL_HASHES.items(), ids=list(OFFICIAL_HASHES))
def test_a_type_is_published_under_the_official_hash(node: Node, name: str, official: str) -> None:
    node.create_publisher(getattr(msg, name), "/typed", 1)
    (endpoint,) = node.get_publishers_info_by_topic("/typed")
    assert endpoint.topic_type == f"vision_msgs/msg/{name}"
    assert str(endpoint.topic_type_hash) == official


def test_every_message_definition_is_compared() -> None:
    definitions = REPOSITORY / "interfaces" / "vision_msgs" / "msg"
    assert {file.stem for file in definitions.glob("*.msg")} == OFFICIAL_HASHES.keys()
