"""The node's topics, for each camera: their remapped names, and QoS overrides given at startup.

An override is a parameter such as `qos_overrides.TOPIC.publisher.POLICY`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import Literal

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSPolicyKind, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from yolov5_lifecycle.ros.rclpy_internals import parameter_overrides
from yolov5_lifecycle.settings.schema import Problem
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.settings.suggestion import did_you_mean
from yolov5_lifecycle.settings.synonyms import QOS_PREFIX
from yolov5_lifecycle.settings.value_text import value_text

DETECTIONS = "~/detections"
DETECTIONS_3D = "~/detections_3d"
POINTS = "~/points"
MASKS = "~/masks"
IMAGE = "~/image"
COMPRESSED_IMAGE = "~/image/compressed"
LABEL_INFO = "~/label_info"
IMAGE_RAW = "~/image_raw"
COMPRESSED_IMAGE_RAW = "~/image_raw/compressed"
DEPTH_IMAGE_RAW = "~/depth/image_raw"
DEPTH_CAMERA_INFO = "~/depth/camera_info"

COLOUR_IMAGES = (IMAGE_RAW, COMPRESSED_IMAGE_RAW)
_PUBLISHED = (DETECTIONS, DETECTIONS_3D, POINTS, MASKS, IMAGE, COMPRESSED_IMAGE)
_SUBSCRIBED = (*COLOUR_IMAGES, DEPTH_IMAGE_RAW, DEPTH_CAMERA_INFO)
_OTHERS = ("/diagnostics", "/rosout", "/parameter_events")

_COMPRESSED = "/compressed"

Kind = Literal["publisher", "subscription"]

MAX_DEPTH = 10_000

_CHOICES = {
    "history": [name for name in HistoryPolicy.short_keys() if name != "unknown"],
    "reliability": [name for name in ReliabilityPolicy.short_keys() if name != "unknown"],
}
_POLICIES = (*_CHOICES, "depth")
_REMEDY = "Correct it and restart the node."


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


def qos_problems(node: Node, cameras: Sequence[str]) -> list[Problem]:
    """QoS overrides that are invalid or match no topic of `node` with these `cameras`."""
    topics: dict[Kind, list[str]] = {"publisher": published(cameras), "subscription": subscribed(cameras)}
    policy_of = {
        _name(node, topic, kind, policy): policy
        for kind in topics
        for topic in topics[kind]
        for policy in _POLICIES
    }
    problems = []
    for name, override in parameter_overrides(node).items():
        if name not in policy_of and name.startswith(QOS_PREFIX):
            problems.append(Problem(name, _unknown(name, policy_of)))
        elif name in policy_of and (rule := _broken_rule(policy_of[name], override)):
            problems.append(Problem(name, f"{value_text(override.value)} is not {rule} {_REMEDY}"))
    return problems


def reliability_problems(node: Node, settings: Settings) -> list[Problem]:
    """A QoS override and `image_reliability` must not both set a camera's reliability."""
    overrides = [name for name in parameter_overrides(node) if name.startswith(QOS_PREFIX)]
    problems = []
    for camera in settings.camera_names if overrides else ():
        reliability = settings.for_camera(camera).image_reliability
        topics = [of_camera(topic, camera) for topic in COLOUR_IMAGES]
        with suppress(RuntimeError):  # of a name that ROS refuses, which `configure` refuses, too
            names = [_name(node, topic, "subscription", "reliability") for topic in topics]
            if reliability != "auto" and (given := [name for name in names if name in overrides]):
                reason = f"{reliability!r} and {given[0]} both set the reliability of the subscription."
                is_inherited = reliability == settings.image_reliability
                name = "image_reliability" if is_inherited else f"{camera}.image_reliability"
                problems.append(Problem(name, f"{reason} Use 'auto', or start without the override."))
    return problems


def overridden_reliability(node: Node, topic: str) -> ReliabilityPolicy | None:
    """Reliability that an override sets for the subscription to `topic`, None without an override."""
    override = parameter_overrides(node).get(_name(node, topic, "subscription", "reliability"))
    return None if override is None else ReliabilityPolicy[override.value.upper()]


def overriding_options(node: Node, topic: str, kind: Kind) -> QoSOverridingOptions:
    """Options for the endpoint of `topic`, limited to the policies that have an override."""
    # rclpy fixes every policy listed here to its first value: without an override, the reliability of the
    # image subscription could no longer follow the camera.
    overrides = parameter_overrides(node)
    return QoSOverridingOptions(
        [
            QoSPolicyKind[policy.upper()]
            for policy in _POLICIES
            if _name(node, topic, kind, policy) in overrides
        ]
    )


def _name(node: Node, topic: str, kind: Kind, policy: str) -> str:
    """Name of the parameter that overrides `policy` of the endpoint of `topic`."""
    return f"{QOS_PREFIX}{full_name(node, topic)}.{kind}.{policy}"


def _unknown(name: str, known: Collection[str]) -> str:
    hint = did_you_mean(name, known)
    if not hint:
        endpoints = dict.fromkeys(other.removeprefix(QOS_PREFIX).rpartition(".")[0] for other in known)
        hint = f" Expected one of {', '.join(endpoints)}, each with {', '.join(_POLICIES)}."
    return f"this node has no such topic or policy.{hint} {_REMEDY}"


def _broken_rule(policy: str, override: Parameter) -> str:
    """The rule that `override` violates, "" if it is valid."""
    if policy == "depth":
        is_valid = override.type_ is Parameter.Type.INTEGER and 1 <= override.value <= MAX_DEPTH
        return "" if is_valid else f"an integer from 1 to {MAX_DEPTH}."
    value, choices = override.value, _CHOICES[policy]
    if value in choices:
        return ""
    hint = did_you_mean(value, choices) if isinstance(value, str) else ""
    return f"one of {', '.join(choices)}.{hint}"
