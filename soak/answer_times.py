"""How long services take while images are being detected."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from soak.finding import Finding
from soak.subject import Subject, camera

_RATE_HZ = 30.0
_LIMIT_MS = 20.0
_ROUNDS = 3
"""A figure in time is the best of these: whatever else the machine does only makes it worse."""


def answers_during_inference(subject: Subject, count: int, *, is_timed: bool = True) -> Finding:
    """Ask for the state and for a parameter in turn; unless `is_timed`, time is not judged."""
    subject.reset()
    subject.bring_to("active")
    node, times_ms = subject.node, []
    questions = (lambda: node.state() == "active", lambda: node.parameter("lazy") is True)
    with camera(subject.domain, rate=_RATE_HZ, width=640, height=480):
        subject.observer.wait_for(lambda: bool(subject.detections), "detections")
        for index in range(count):
            begun_s = time.monotonic()
            assert questions[index % 2]()
            times_ms.append((time.monotonic() - begun_s) * 1e3)
            subject.observer.work_for(0.002)
        detected = len(subject.detections)
    subject.reset()
    size = math.ceil(count / _ROUNDS)
    p99_ms = [_p99(times_ms[begin : begin + size]) for begin in range(0, count, size)]
    return Finding(
        claim="services answer during inference",
        done=f"{count} requests while {detected} images were detected",
        result=f"p99 {', '.join(f'{time_ms:.1f}' for time_ms in p99_ms)} ms, longest {max(times_ms):.1f} ms",
        limit=f"best p99 of {_ROUNDS} rounds < {_LIMIT_MS:g} ms" if is_timed else "answered",
        is_met=min(p99_ms) < _LIMIT_MS or not is_timed,
    )


def _p99(times_ms: Sequence[float]) -> float:
    return sorted(times_ms)[math.ceil(0.99 * len(times_ms)) - 1]
