"""Validated request to change parameters, and the result that refuses one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rcl_interfaces.msg import SetParametersResult
from rclpy.parameter import Parameter

from yolov5_lifecycle.settings.schema import Change, Problem
from yolov5_lifecycle.settings.settings import Settings


@dataclass(frozen=True, eq=False)
class Configuration:
    """Values of all settings and overrides, with the resulting settings or problems. Compared by identity."""

    values: Mapping[str, object]
    settings: Settings | None
    """None if there are problems."""
    problems: tuple[Problem, ...] = ()


@dataclass(frozen=True, eq=False)
class Proposal:
    """Changes that one request makes to `base`, the configuration it was validated against.

    It may be stored if `base` is still the current configuration and it has no `problems`.
    """

    base: Configuration
    after: Configuration
    """`base` itself if no setting changes."""
    kind: Change | None
    """The most expensive kind of change; None if no setting changes or the settings are invalid."""
    asked: tuple[Parameter, ...]
    """Parameters as requested."""
    parameters: tuple[Parameter, ...]
    """Parameters to set: coerced to the types of their settings, without those that need no change."""
    withdrawn: tuple[str, ...] = ()
    """Unusable overrides, given at the start, that the request deletes."""
    unknown: tuple[str, ...] = ()
    """Requested names that are not parameters."""
    problems: tuple[Problem, ...] = ()
    """Why the request must be refused; excludes problems that `base` already has."""
    unsolved: tuple[Problem, ...] = ()
    """Problems that the change adds and another one can solve: accepted while the node is unconfigured."""


MAX_REASON_LENGTH = 2000
"""Max length of the refusal of one change, in characters."""


def refusal(problems: Sequence[Problem]) -> SetParametersResult:
    """Result that rejects a change because of `problems`; the reason is at most MAX_REASON_LENGTH long."""
    return SetParametersResult(successful=False, reason=_reason(problems))


def acceptance(proposal: Proposal) -> SetParametersResult:
    """Result of a stored change with `unsolved` problems; `ros2 param set` shows them beside the success."""
    remark = f"change another parameter, too, or configure is refused: {_reason(proposal.unsolved)}"
    return SetParametersResult(successful=True, reason=remark)


def _reason(problems: Sequence[Problem]) -> str:
    reason = " ".join(map(str, problems))
    if len(reason) <= MAX_REASON_LENGTH:
        return reason
    return f"{reason[:MAX_REASON_LENGTH]}... ({len(problems)} problems)"
