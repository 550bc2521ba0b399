"""QoS overrides given at startup, such as `qos_overrides.TOPIC.publisher.POLICY`."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSPolicyKind, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from yolov5_lifecycle.ros.rclpy_internals import parameter_overrides
from yolov5_lifecycle.ros.topics import COLOUR_IMAGES, PUBLISHED, SUBSCRIBED, full_name
from yolov5_lifecycle.settings.parameter_file import QOS_PREFIX
from yolov5_lifecycle.settings.schema import Problem
from yolov5_lifecycle.settings.settings import Settings
from yolov5_lifecycle.settings.suggestion import did_you_mean

MAX_DEPTH = 10_000

_CHOICES = {
    "history": [name for name in HistoryPolicy.short_keys() if name != "unknown"],
    "reliability": [name for name in ReliabilityPolicy.short_keys() if name != "unknown"],
}
_POLICIES = (*_CHOICES, "depth")
_REMEDY = "Correct it and restart the node."


def qos_problems(node: Node) -> list[Problem]:
    """QoS overrides that are invalid or match no topic of `node`; fixing them needs a restart."""
    topics = (*PUBLISHED, *SUBSCRIBED)
    policy_of = {_name(node, topic, policy): policy for topic in topics for policy in _POLICIES}
    problems = []
    for name, override in parameter_overrides(node).items():
        if name not in policy_of and name.startswith(QOS_PREFIX):
            problems.append(Problem(name, _unknown(name, policy_of)))
        elif name in policy_of and (rule := _broken_rule(policy_of[name], override)):
            problems.append(
                Problem(name, f"{override.value!r} is not {rule} Correct it and restart the node.")
            )
    return problems


def qos_rules(node: Node) -> list[Callable[[Settings], list[Problem]]]:
    """One rule per QoS override that conflicts with or duplicates a value of `image_reliability`."""
    overrides = parameter_overrides(node)
    names = [_name(node, topic, "reliability") for topic in COLOUR_IMAGES]
    return [partial(_reliability_problems, name) for name in names if name in overrides]


def _reliability_problems(override: str, settings: Settings) -> list[Problem]:
    if settings.image_reliability == "auto":
        return []
    reason = f"{settings.image_reliability!r} and {override} both set the reliability of the subscription."
    return [Problem("image_reliability", f"{reason} Use 'auto', or start without the override.")]


def overridden_reliability(node: Node, topic: str) -> ReliabilityPolicy | None:
    """Reliability that an override sets for the subscription to `topic`, None without an override."""
    override = parameter_overrides(node).get(_name(node, topic, "reliability"))
    return None if override is None else ReliabilityPolicy[override.value.upper()]


def overriding_options(node: Node, topic: str) -> QoSOverridingOptions:
    """Options for the endpoint of `topic`, limited to the policies that have an override."""
    # rclpy fixes every policy listed here to its first value: without an override, the reliability of the
    # image subscription could no longer follow the camera.
    overrides = parameter_overrides(node)
    return QoSOverridingOptions(
        [QoSPolicyKind[policy.upper()] for policy in _POLICIES if _name(node, topic, policy) in overrides]
    )


def _name(node: Node, topic: str, policy: str) -> str:
    """Name of the parameter that overrides `policy` of the endpoint of `topic`."""
    kind = "publisher" if topic in PUBLISHED else "subscription"
    return f"{QOS_PREFIX}{full_name(node, topic)}.{kind}.{policy}"


def _unknown(name: str, known: dict[str, str]) -> str:
    hint = did_you_mean(name, known)
    if not hint:
        endpoints = dict.fromkeys(other.removeprefix(QOS_PREFIX).rpartition(".")[0] for other in known)
        hint = f" There are {', '.join(endpoints)}, each with {', '.join(_POLICIES)}."
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
