"""Bursts of simultaneous requests from one client, as many as the service queues hold."""

from __future__ import annotations

import contextlib
from typing import Any

from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from support.detector_process import NODE

from soak.finding import Finding, number_of
from soak.subject import Subject
from yolov5_lifecycle.ros.observer import NoAnswerError

LIFECYCLE_QUEUE = 10
"""Queue length of each rcl_lifecycle service; older requests are overwritten."""
_BURST = 80
_KEPT = QoSProfile(depth=1000)
"""Response queue of a client that takes responses later than they arrive."""
_PATIENCE_S = 60.0
_FIRST_ANSWER_S = 1.0
_SIZES = (320, 352, 384, 416)


def answered_bursts(subject: Subject, rounds: int) -> Finding:
    """Send bursts of requests for the state, a parameter and reloads, `rounds` times each."""
    subject.reset()
    subject.bring_to("active")
    unanswered: list[str] = []
    superseded = 0
    for _ in range(rounds):
        unanswered += _unanswered(subject, _states(subject))
        unanswered += _unanswered(subject, _values(subject))
        reloads = _reloads(subject)
        unanswered += _unanswered(subject, reloads)
        reasons = [future.result().results[0].reason for future in reloads.futures if future.done()]
        superseded += sum("superseded" in reason for reason in reasons)
    subject.look()
    subject.reset()
    return Finding(
        claim="every request of a burst is answered, and a queue of reloads loads few models",
        done=f"{rounds} bursts of {LIFECYCLE_QUEUE} get_state, {_BURST} get_parameters and {_BURST} reloads",
        result=f"{number_of('unanswered', unanswered)}, {superseded / rounds:.0f} of {_BURST} superseded, "
        f"{number_of('exceptions', subject.escaped)}",
        limit=f"0, at least {_BURST // 2}, 0",
        is_met=not unanswered and superseded >= rounds * _BURST // 2 and not subject.escaped,
    )


class _Burst:
    """Simultaneous requests of one client."""

    def __init__(self, subject: Subject, service_type: Any, name: str, requests: list[Any]) -> None:
        self.name = name
        self.client = subject.observer.create_client(service_type, f"{NODE}/{name}", qos_profile=_KEPT)
        _reach(subject, self.client)
        self.futures = [self.client.call_async(request) for request in requests]


def _reach(subject: Subject, client: Any) -> None:
    """Wait for a first response; those sent before the node has discovered the client are lost."""

    def is_answered() -> bool:
        with contextlib.suppress(NoAnswerError):
            subject.observer.call(client, client.srv_type.Request(), timeout_s=_FIRST_ANSWER_S)
            return True
        return False

    subject.observer.wait_for(is_answered, client.srv_name)


def _states(subject: Subject) -> _Burst:
    return _Burst(subject, GetState, "get_state", [GetState.Request()] * LIFECYCLE_QUEUE)


def _values(subject: Subject) -> _Burst:
    return _Burst(subject, GetParameters, "get_parameters", [GetParameters.Request(names=["lazy"])] * _BURST)


def _reloads(subject: Subject) -> _Burst:
    requests = [
        SetParameters.Request(
            parameters=[Parameter("image_size", value=_SIZES[number % len(_SIZES)]).to_parameter_msg()]
        )
        for number in range(_BURST)
    ]
    return _Burst(subject, SetParameters, "set_parameters", requests)


def _unanswered(subject: Subject, burst: _Burst) -> list[str]:
    """The name of the service for each request without a response; destroys the client."""

    def is_answered() -> bool:
        return all(future.done() for future in burst.futures)

    with contextlib.suppress(NoAnswerError):  # reported in the finding
        subject.observer.wait_for(is_answered, "the answers to a burst", timeout_s=_PATIENCE_S)
    subject.observer.destroy_client(burst.client)
    return [burst.name for future in burst.futures if not future.done()]
