"""The node's topics, and where remapping leads them."""

from __future__ import annotations

from rclpy.node import Node

DETECTIONS = "~/detections"
IMAGE = "~/image"
COMPRESSED_IMAGE = "~/image/compressed"
LABEL_INFO = "~/label_info"
IMAGE_RAW = "~/image_raw"
COMPRESSED_IMAGE_RAW = "~/image_raw/compressed"

PUBLISHED = (DETECTIONS, IMAGE, COMPRESSED_IMAGE, LABEL_INFO)
SUBSCRIBED = (IMAGE_RAW, COMPRESSED_IMAGE_RAW)

_COMPRESSED = "/compressed"


def endpoint_name(node: Node, topic: str) -> str:
    """The name to create an endpoint of `topic` with, before remapping.

    A compressed topic follows where its raw one was remapped to, as with image_transport.
    """
    if not topic.endswith(_COMPRESSED):
        return topic
    return str(node.resolve_topic_name(topic.removesuffix(_COMPRESSED))) + _COMPRESSED


def full_name(node: Node, topic: str) -> str:
    """The name of `topic` in the ROS graph."""
    return str(node.resolve_topic_name(endpoint_name(node, topic)))
