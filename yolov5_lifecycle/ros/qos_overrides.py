"""QoS overrides given at startup, such as `qos_overrides.TOPIC.publisher.POLICY`."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSPolicyKind, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from yolov5_lifecycle.ros.topics import PUBLISHED, SUBSCRIBED, full_name
from yolov5_lifecycle.settings.parameter_file import QOS_PREFIX
from yolov5_lifecycle.settings.settings import Problem, Settings
from yolov5_lifecycle.settings.suggestion import did_you_mean

MAX_DEPTH = 10_000

_CHOICES = {
    "history": [name for name in HistoryPolicy.short_keys() if name != "unknown"],
    "reliability": [name for name in ReliabilityPolicy.short_keys() if name != "unknown"],
}
_POLICIES = (*_CHOICES, "depth")


def parameter_overrides(node: Node) -> dict[str, Parameter]:
    """Overrides from parameter files and the command line by name, declared or not."""
    # rclpy has no public way to list overrides of undeclared parameters.
    return dict(getattr(node, "_parameter_overrides", {}))


def qos_problems(node: Node) -> list[Problem]:
    """QoS overrides that are invalid or match no topic of `node`; fixing them needs a restart."""
    topics = (*PUBLISHED, *SUBSCRIBED)
    policy_of = {_name(node, topic, policy): policy for topic in topics for policy in _POLICIES}
    problems = []
    for name, override in parameter_overrides(node).items():
        if name not in policy_of and name.startswith(QOS_PREFIX):
            problems.append(Problem(name, _unknown(name, policy_of)))
        elif name in policy_of and (rule := _broken_rule(policy_of[name], override)):
            problems.append(Problem(name, f"{override.value!r} is not {rule} Correct it and start again."))
    return problems


def qos_contradictions(node: Node, settings: Settings) -> list[Problem]:
    """Settings that conflict with or duplicate a QoS override."""
    if settings.image_reliability == "auto":
        return []
    overrides = parameter_overrides(node)
    names = [name for topic in SUBSCRIBED if (name := _name(node, topic, "reliability")) in overrides]
    return [
        Problem(
            "image_reliability",
            f"{settings.image_reliability!r} and {name} both say how to subscribe. Use 'auto', or start "
            "without the override.",
        )
        for name in names
    ]


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
    return f"this node has no such topic or policy.{hint} Correct it and start again."


def _broken_rule(policy: str, override: Parameter) -> str:
    """The rule that `override` violates, "" if it is valid."""
    if policy == "depth":
        is_whole = override.type_ is Parameter.Type.INTEGER and 1 <= override.value <= MAX_DEPTH
        return "" if is_whole else f"an integer from 1 to {MAX_DEPTH}."
    value, choices = override.value, _CHOICES[policy]
    if value in choices:
        return ""
    hint = did_you_mean(value, choices) if isinstance(value, str) else ""
    return f"one of {', '.join(choices)}.{hint}"
