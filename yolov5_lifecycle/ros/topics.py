"""The node's topics, for each camera, and their remapped names."""

from __future__ import annotations

from collections.abc import Sequence

from rclpy.node import Node

DETECTIONS = "~/detections"
DETECTIONS_3D = "~/detections_3d"
MASKS = "~/masks"
IMAGE = "~/image"
COMPRESSED_IMAGE = "~/image/compressed"
LABEL_INFO = "~/label_info"
IMAGE_RAW = "~/image_raw"
COMPRESSED_IMAGE_RAW = "~/image_raw/compressed"
DEPTH_IMAGE_RAW = "~/depth/image_raw"
DEPTH_CAMERA_INFO = "~/depth/camera_info"

COLOUR_IMAGES = (IMAGE_RAW, COMPRESSED_IMAGE_RAW)
_PUBLISHED = (DETECTIONS, DETECTIONS_3D, MASKS, IMAGE, COMPRESSED_IMAGE)
_SUBSCRIBED = (*COLOUR_IMAGES, DEPTH_IMAGE_RAW, DEPTH_CAMERA_INFO)
_OTHERS = ("/diagnostics", "/rosout", "/parameter_events")

_COMPRESSED = "/compressed"


def of_camera(topic: str, camera: str) -> str:
    """`topic` of a camera in `cameras`: `~/front/image_raw` for `~/image_raw`; "": the one without a name."""
    return topic.replace("~/", f"~/{camera}/", 1) if camera else topic


def published(cameras: Sequence[str]) -> list[str]:
    """Topics that the node publishes with these `cameras`."""
    return [of_camera(topic, camera) for camera in cameras for topic in _PUBLISHED] + [LABEL_INFO]


def subscribed(cameras: Sequence[str]) -> list[str]:
    """Topics that the node may subscribe to with these `cameras`."""
    return [of_camera(topic, camera) for camera in cameras for topic in _SUBSCRIBED]


def endpoint_name(node: Node, topic: str) -> str:
    """Name with which to create the endpoint of `topic`, before remapping.

    A compressed topic follows the remapping of its raw topic, as with image_transport.
    """
    if not topic.endswith(_COMPRESSED):
        return topic
    return str(node.resolve_topic_name(topic.removesuffix(_COMPRESSED))) + _COMPRESSED


def topic_problems(node: Node, cameras: Sequence[str]) -> list[str]:
    """One problem per name to which several topics of `node` with these `cameras` are remapped.

    Only the first topic if ROS refuses its full name as too long.
    """
    topic, by_name = "", dict[str, list[str]]()
    try:
        for topic in (*published(cameras), *subscribed(cameras), *_OTHERS):
            by_name.setdefault(full_name(node, topic), []).append(topic)
    except RuntimeError as error:
        reason = str(error).partition(", at /")[0]
        return [
            f"ROS refuses the full name of {topic}: {reason}: use a shorter name for the camera, or restart "
            "the node with a shorter namespace or other remappings"
        ]
    return [
        f"{' and '.join(topics)} are remapped to the same topic, {name}: restart the node with "
        "different remappings"
        for name, topics in by_name.items()
        if len(topics) > 1
    ]


def full_name(node: Node, topic: str) -> str:
    """Name of `topic` in the ROS graph."""
    return str(node.resolve_topic_name(endpoint_name(node, topic)))
