"""QoS that users override when they start the node: `qos_overrides.TOPIC.publisher.POLICY` and so on."""

from __future__ import annotations

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import HistoryPolicy, QoSPolicyKind, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from yolov5_lifecycle.parameter_file import QOS_PREFIX
from yolov5_lifecycle.ros.topics import PUBLISHED, SUBSCRIBED, full_name
from yolov5_lifecycle.settings import Problem, Settings
from yolov5_lifecycle.suggestion import did_you_mean

MAX_DEPTH = 10_000

_CHOICES = {
    "history": [name for name in HistoryPolicy.short_keys() if name != "unknown"],
    "reliability": [name for name in ReliabilityPolicy.short_keys() if name != "unknown"],
}
_POLICIES = (*_CHOICES, "depth")


def parameter_overrides(node: Node) -> dict[str, Parameter]:
    """What parameter files and the command line say, by name, whether declared or not."""
    # rclpy has no public way to list overrides that nobody declared.
    return dict(getattr(node, "_parameter_overrides", {}))


def qos_problems(node: Node) -> list[Problem]:
    """Overrides of QoS that no topic of `node` can obey; only another start can mend them."""
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
    """Settings that say otherwise, or again, what an override says."""
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
    """What a valid override asks of the subscription to `topic`, None when there is none."""
    override = parameter_overrides(node).get(_name(node, topic, "reliability"))
    return None if override is None else ReliabilityPolicy[override.value.upper()]


def overriding_options(node: Node, topic: str) -> QoSOverridingOptions:
    """For the endpoint of `topic`: the policies that valid overrides name, and no others."""
    # rclpy keeps the first value of every policy that is named here: an unasked-for reliability of the images
    # could no longer follow the camera.
    overrides = parameter_overrides(node)
    return QoSOverridingOptions(
        [QoSPolicyKind[policy.upper()] for policy in _POLICIES if _name(node, topic, policy) in overrides]
    )


def _name(node: Node, topic: str, policy: str) -> str:
    """The parameter that overrides `policy` of the endpoint of `topic`."""
    kind = "publisher" if topic in PUBLISHED else "subscription"
    return f"{QOS_PREFIX}{full_name(node, topic)}.{kind}.{policy}"


def _unknown(name: str, known: dict[str, str]) -> str:
    hint = did_you_mean(name, known)
    if not hint:
        endpoints = dict.fromkeys(other.removeprefix(QOS_PREFIX).rpartition(".")[0] for other in known)
        hint = f" There are {', '.join(endpoints)}, each with {', '.join(_POLICIES)}."
    return f"this node has no such topic or policy.{hint} Correct it and start again."


def _broken_rule(policy: str, override: Parameter) -> str:
    """What `override` must be and is not, "" when it is."""
    if policy == "depth":
        is_whole = override.type_ is Parameter.Type.INTEGER and 1 <= override.value <= MAX_DEPTH
        return "" if is_whole else f"a whole number from 1 to {MAX_DEPTH}."
    value, choices = override.value, _CHOICES[policy]
    if value in choices:
        return ""
    hint = did_you_mean(value, choices) if isinstance(value, str) else ""
    return f"one of {', '.join(choices)}.{hint}"
