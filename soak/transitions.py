"""Every possible transition request, in every primary state."""

from __future__ import annotations

from collections.abc import Iterator

from lifecycle_msgs.msg import Transition

from soak.finding import Finding, none_wrong, none_wrong_nor_escaped
from soak.subject import Subject, subject
from yolov5_lifecycle.ros.detector.command import FINALIZED_S

Request = tuple[str, int]
"""Label and number; the number is used if the label is empty."""

_LEGAL = {
    "unconfigured": {
        ("configure", Transition.TRANSITION_CONFIGURE): "inactive",
        ("shutdown", Transition.TRANSITION_UNCONFIGURED_SHUTDOWN): "finalized",
    },
    "inactive": {
        ("activate", Transition.TRANSITION_ACTIVATE): "active",
        ("cleanup", Transition.TRANSITION_CLEANUP): "unconfigured",
        ("shutdown", Transition.TRANSITION_INACTIVE_SHUTDOWN): "finalized",
    },
    "active": {
        ("deactivate", Transition.TRANSITION_DEACTIVATE): "inactive",
        ("shutdown", Transition.TRANSITION_ACTIVE_SHUTDOWN): "finalized",
    },
}
_LABELS = (
    *("configure", "cleanup", "activate", "deactivate", "shutdown", "create", "destroy"),
    *("transition_success", "transition_failure", "transition_error", "on_configure", "close"),
    *("nonsense", "Configure", " configure", "configure\n", "конфигурация", "%s%n", "x" * 1_000_000),
)
_END_S = FINALIZED_S + 5.0


def answered_transitions(subject: Subject) -> Finding:
    """Request every number and many labels in every state, except those that end the process."""
    wrong, asked = [], 0
    for state, (label, number), expected in _pairs():
        if expected != "finalized":
            subject.bring_to(state)
            granted = subject.transition(label, number)
            found = (granted, subject.node.state())
            asked += 1
            if found != (expected is not None, expected or state):
                wrong.append(f"{state} {label[:20]!r} {number}: {found}")
    return none_wrong_nor_escaped(
        "every transition in every state is answered",
        f"{asked} pairs of state and transition",
        "wrong answers or states",
        wrong,
        subject.escaped,
    )


def answered_shutdowns(most: int | None = None, *, end_s: float = _END_S) -> Finding:
    """Request shutdown by label and by number in every state, each in a new process, which must report that
    it is finalized and then end.

    `most` limits the number of these pairs.
    """
    wrong = []
    pairs = [(state, request) for state, request, expected in _pairs() if expected == "finalized"][:most]
    for state, (label, number) in pairs:
        with subject() as process:
            process.bring_to(state)
            granted, then = process.transition(label, number), process.node.state()
            code = process.process.wait(end_s)
            if (granted, then, code, process.escaped) != (True, "finalized", 0, []):
                wrong.append(f"{state} {label!r} {number}: {granted}, {then}, exit code {code}")
    return none_wrong(
        "shutdown in every state is answered, then ends the process",
        f"{len(pairs)} processes",
        "wrong answers, states or exit codes",
        wrong,
        limit=f"0; exit code 0 within {end_s:g} s",
    )


def _pairs() -> Iterator[tuple[str, Request, str | None]]:
    """State, request and the resulting state, None if the request must be rejected."""
    for state, legal in _LEGAL.items():
        by_label = {label: after for (label, _), after in legal.items()}
        by_number = {number: after for (_, number), after in legal.items()}
        yield from ((state, ("", number), by_number.get(number)) for number in range(256))
        yield from ((state, (label, 0), by_label.get(label)) for label in _LABELS)
        # The label takes precedence over the number.
        yield from ((state, ("nonsense", number), None) for number in by_number)
