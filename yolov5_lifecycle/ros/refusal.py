"""Results that refuse a change of parameters."""

from __future__ import annotations

from collections.abc import Sequence

from rcl_interfaces.msg import SetParametersResult

from yolov5_lifecycle.settings.schema import Problem

MAX_REASON_LENGTH = 2000
"""Max length of the refusal of one change, in characters."""


def refusal(problems: Sequence[Problem]) -> SetParametersResult:
    """Result that rejects a change because of `problems`, truncated to MAX_REASON_LENGTH."""
    reason = " ".join(map(str, problems))
    if len(reason) > MAX_REASON_LENGTH:
        reason = f"{reason[:MAX_REASON_LENGTH]}... ({len(problems)} problems)"
    return SetParametersResult(successful=False, reason=reason)
