"""Floods of parameter requests of up to a megabyte: effect on other services and on process exit."""

from __future__ import annotations

import re
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from support.detector_process import environment

from soak import flooding_client
from soak.answer_times import ROUNDS_NOTE, asked, usual_p99
from soak.finding import Finding, none_wrong, number_of
from soak.flooding_client import FLOODS
from soak.subject import Subject, subject
from yolov5_lifecycle.ros.child_process import ChildProcess

_LIMIT_MS = 1000.0
_END_S = 5.0
_FIRST_ANSWER_S = 60.0


def answers_beside_floods(
    subject: Subject, count: int, *, floods: Iterable[str] = FLOODS, is_timed: bool = True
) -> Finding:
    """Request the state and a parameter `count` times during each of the `floods` of an active node.

    Time is only judged if `is_timed`.
    """
    subject.reset()
    subject.bring_to("active")
    p99_ms: dict[str, float] = {}
    sent = 0
    for name in floods:
        with _flood(subject.domain, name) as client:
            p99_ms[name] = usual_p99(asked(subject, most=count))
            sent += _answered(client)
    subject.reset()
    slowest = max(p99_ms, key=p99_ms.__getitem__)
    return Finding(
        claim="services answer beside requests of a megabyte",
        done=f"{sent} requests of {len(p99_ms)} kinds, {count} others beside each",
        result=f"p99 at most {p99_ms[slowest]:.1f} ms ({slowest}), "
        f"{number_of('exceptions', subject.escaped)}",
        limit=f"p99 < {_LIMIT_MS:g} ms ({ROUNDS_NOTE}), 0" if is_timed else "answered, 0",
        is_met=(p99_ms[slowest] < _LIMIT_MS or not is_timed) and not subject.escaped,
    )


def endings_beside_floods(floods: Iterable[str] = FLOODS, *, limit_s: float = _END_S) -> Finding:
    """Terminate an active process with SIGTERM during each of the `floods`."""
    floods, wrong = list(floods), []
    for name in floods:
        with subject() as process:
            process.bring_to("active")
            with _flood(process.domain, name):
                code = process.process.stop(signal.SIGTERM, timeout_s=limit_s)
            if code != 0 or process.escaped:
                wrong.append(f"{name}: exit code {code}, {process.escaped}")
    return none_wrong(
        "SIGTERM ends the process beside requests of a megabyte",
        f"{len(floods)} processes",
        "other ends",
        wrong,
        limit=f"0; exit code 0 within {limit_s:g} s, no exception",
    )


@contextmanager
def _flood(domain: int, name: str) -> Iterator[ChildProcess]:
    """A client that floods the node, ready once it has its first response."""
    command = [sys.executable, flooding_client.__file__, name]
    with ChildProcess("flood", command, environment(domain)) as client:
        client.wait_for_output("answered", _FIRST_ANSWER_S)
        yield client


def _answered(client: ChildProcess) -> int:
    return int(re.findall(r"answered (\d+)", client.output)[-1])
