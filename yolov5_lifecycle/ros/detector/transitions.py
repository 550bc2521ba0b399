"""Lifecycle transitions: exception logging and request checks that rclpy lacks."""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from yolov5_lifecycle.printable import in_one_line

SUCCESS, FAILURE, ERROR = (
    TransitionCallbackReturn.SUCCESS,
    TransitionCallbackReturn.FAILURE,
    TransitionCallbackReturn.ERROR,
)


class Reporting(Protocol):
    """A node that reports problems in its log and diagnostics."""

    def report(self, problem: str) -> None: ...

    def get_logger(self) -> RcutilsLogger: ...


ReportingNode = TypeVar("ReportingNode", bound=Reporting)
Transition = Callable[[ReportingNode, LifecycleState], TransitionCallbackReturn]


def logged(transition: Transition[ReportingNode]) -> Transition[ReportingNode]:
    """Log an exception in a transition, which rclpy turns into a silent ERROR (ros2/rclpy#1673)."""

    @functools.wraps(transition)
    def guarded(node: ReportingNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except Exception as error:  # noqa: BLE001 - logged with its traceback, answered with ERROR
            node.report(f"unexpected {type(error).__name__} in {transition.__name__}: {error}")
            node.get_logger().error(traceback.format_exc())
            return ERROR

    return guarded


def requested_label(wanted: Any, possible: Sequence[tuple[Any, ...]]) -> str | None:
    """Label of the transition that the `lifecycle_msgs/Transition` `wanted` requests, None if not possible.

    `possible`: rows (id, label, ...). A label takes precedence over an id. For an impossible transition rclpy
    would raise (ros2/rclpy#1209).
    """
    column, value = (1, wanted.label) if wanted.label else (0, wanted.id)
    return next((str(row[1]) for row in possible if row[column] == value), None)


def refused_transition(wanted: Any, possible: Sequence[tuple[Any, ...]], state: str) -> str:
    """Explain why `wanted` is refused in `state`, and list the possible transitions."""
    asked = in_one_line(wanted.label[:100]) or wanted.id
    names = ", ".join(f"{row[1]} ({row[0]})" for row in possible) or "none"
    return f"transition '{asked}' refused in state {state}. Possible now: {names}."
