"""Service response times during inference and model loading."""

from __future__ import annotations

import itertools
import math
import statistics
import time
from collections.abc import Callable, Sequence

from soak.faults import faulty_image
from soak.finding import Finding
from soak.sender import Sender
from soak.subject import Subject, camera

_RATE_HZ = 30.0
_LIMIT_MS = 20.0
_ROUNDS = 3
ROUNDS_NOTE = f"the middle one of {_ROUNDS} rounds"
_PAUSE_S = 0.002
_SIZES = (416, 320)


def answers_during_inference(subject: Subject, count: int, *, is_timed: bool = True) -> Finding:
    """Request the state and a parameter alternately: `count` times during detection, a third as often while
    models are loaded and while inference hangs; time is only judged if `is_timed`.

    All detections must also be received here.
    """
    subject.reset()
    subject.bring_to("active")
    while_detecting, detected = _while_detecting(subject, count)
    p99_ms = {
        "detecting": usual_p99(while_detecting),
        "loading": usual_p99(_while_loading(subject, math.ceil(count / 3))),
        "hung": usual_p99(_while_hung(subject, math.ceil(count / 3))),
    }
    subject.reset()
    return Finding(
        claim="services answer during inference, and all that is detected comes out",
        done=f"{count} requests while {detected} images were detected, a third as many in the other cases",
        result="p99 " + ", ".join(f"{case} {time_ms:.1f} ms" for case, time_ms in p99_ms.items()),
        limit=f"p99 < {_LIMIT_MS:g} ms ({ROUNDS_NOTE})" if is_timed else "answered",
        is_met=max(p99_ms.values()) < _LIMIT_MS or not is_timed,
    )


def _while_detecting(subject: Subject, count: int) -> tuple[list[float], int]:
    """Milliseconds of each of `count` responses, and the number of images detected meanwhile."""
    heard, told = subject.heard, _detected(subject)
    with camera(subject.domain, rate=_RATE_HZ, width=640, height=480):
        subject.observer.wait_for(lambda: subject.heard > heard, "detections")
        times_ms = asked(subject, most=count)
    detected = _detected(subject) - told
    subject.observer.wait_for(lambda: subject.heard - heard == detected, f"{detected} detections")
    return times_ms, detected


def _while_loading(subject: Subject, count: int) -> list[float]:
    times_ms: list[float] = []
    sizes = itertools.cycle(_SIZES)
    while len(times_ms) < count:
        times_ms += asked(subject, until=subject.begin_reload(next(sizes)).done)
    return times_ms


def _while_hung(subject: Subject, count: int) -> list[float]:
    sender = Sender(subject, "raw")
    sender.wait_until_reliable()  # else the next image is lost, if the node resubscribes meanwhile
    sender.send_whole()
    sender.send(faulty_image("long hang"))
    subject.observer.wait_for(lambda: subject.status()["frames pending"] == "1", "inference to hang")
    times_ms = asked(subject, most=count)
    assert subject.status()["frames pending"] == "1", "it went on"
    assert subject.transition("deactivate")
    sender.close()
    return times_ms


def asked(
    subject: Subject, *, most: float = math.inf, until: Callable[[], bool] = lambda: False
) -> list[float]:
    """Milliseconds of each response."""
    questions = (lambda: subject.node.state() == "active", lambda: subject.node.parameter("lazy") is True)
    times_ms: list[float] = []
    while len(times_ms) < most and not until():
        begun_s = time.monotonic()
        assert questions[len(times_ms) % 2]()
        times_ms.append((time.monotonic() - begun_s) * 1e3)
        subject.observer.work_for(_PAUSE_S)
    return times_ms


def _detected(subject: Subject) -> int:
    return int(subject.status()["frames detected"])


def usual_p99(times_ms: Sequence[float]) -> float:
    """The median of the 99th percentiles of three rounds in a row, because one pause of the machine decides a
    percentile of few responses.
    """
    size = math.ceil(len(times_ms) / _ROUNDS)
    rounds = (times_ms[begin : begin + size] for begin in range(0, len(times_ms), size))
    return statistics.median(_p99(of_round) for of_round in rounds)


def _p99(times_ms: Sequence[float]) -> float:
    return sorted(times_ms)[math.ceil(0.99 * len(times_ms)) - 1]
