"""How long services take while images are being detected."""

from __future__ import annotations

import math
import time

from soak.finding import Finding
from soak.subject import Subject, camera

_RATE_HZ = 30.0
_LIMIT_MS = 20.0


def answers_during_inference(subject: Subject, count: int, *, is_timed: bool = True) -> Finding:
    """Ask for the state and for a parameter in turn; unless `is_timed`, time is not judged."""
    subject.reset()
    subject.bring_to("active")
    times_ms = []
    with camera(subject.domain, rate=_RATE_HZ, width=640, height=480):
        subject.observer.wait_for(lambda: bool(subject.detections), "detections")
        for index in range(count):
            begun_s = time.monotonic()
            assert (
                (subject.node.parameter("lazy") is True) if index % 2 else (subject.node.state() == "active")
            )
            times_ms.append((time.monotonic() - begun_s) * 1e3)
            subject.observer.work_for(0.002)
        detected = len(subject.detections)
    subject.reset()
    p99_ms = sorted(times_ms)[math.ceil(0.99 * count) - 1]
    return Finding(
        claim="services answer during inference",
        done=f"{count} requests while {detected} images were detected",
        result=f"p99 {p99_ms:.1f} ms, longest {max(times_ms):.1f} ms",
        limit=f"p99 < {_LIMIT_MS:g} ms" if is_timed else "answered",
        is_met=p99_ms < _LIMIT_MS or not is_timed,
    )
