"""Inference that fails or hangs, in the real node with the real model."""

from __future__ import annotations

import time
from array import array

from sensor_msgs.msg import Image

from soak.faulty_detector import GREYS
from soak.finding import Finding, number_of
from soak.subject import Sender, Subject
from yolov5_lifecycle.ros.detector.session import REST_TIMEOUT_S

_FAILING = ("raise", "out of memory", "NaN", "wrong shape")
_SIDE_PX = 320
_RETURN_S = REST_TIMEOUT_S + 1


def survived_faults(subject: Subject, count: int, *, is_timed: bool = True) -> Finding:
    """Repeat every fault in one process; the duration of deactivate is only judged if `is_timed`."""
    subject.reset()
    subject.bring_to("active")
    sender, held_s = Sender(subject), 0.0
    for _ in range(count):
        for kind in _FAILING:
            _fail(subject, sender, kind)
            _detect_again(subject, sender)
        sender.send(faulty_image("slow"))
        sender.send_whole()
        held_s = max(held_s, _hang(subject, sender))
        _detect_again(subject, sender)
    sender.close()
    subject.reset()
    return Finding(
        claim="every fault of inference is survived",
        done=f"{', '.join(_FAILING)}, slow, hang: {count} times each",
        result=f"detects again each time; deactivate took {held_s:.1f} s beside a hang; "
        f"{number_of('exceptions', subject.escaped)}",
        limit=f"without a new process; {f'{_RETURN_S:g} s' if is_timed else 'not judged'}; 0",
        is_met=not subject.escaped and (held_s < _RETURN_S or not is_timed),
    )


def faulty_image(kind: str) -> Image:
    """An image that makes inference of the subject fail."""
    data = array("B", bytes([GREYS[kind]]) * (3 * _SIDE_PX**2))
    return Image(height=_SIDE_PX, width=_SIDE_PX, encoding="rgb8", step=3 * _SIDE_PX, data=data)


def _fail(subject: Subject, sender: Sender, kind: str) -> None:
    """Send images that make inference fail until the node deactivates."""

    def has_given_up() -> bool:
        sender.send(faulty_image(kind))
        return subject.node.state() == "inactive"

    subject.observer.wait_for(has_given_up, f"the node to give up after: {kind}")
    assert "failed frames in a row" in subject.status()["last problem"]


def _hang(subject: Subject, sender: Sender) -> float:
    """Deactivate during a hang that the node has reported; returns how long that took, in seconds."""
    failed = int(subject.status()["frames failed"])
    sender.send(faulty_image("hang"))
    subject.observer.wait_for(lambda: "If inference hangs" in subject.status()["message"], "word of the hang")
    begun_s = time.monotonic()
    assert subject.transition("deactivate")
    held_s = time.monotonic() - begun_s
    assert "abandons the thread" in subject.status()["last problem"]
    assert int(subject.status()["frames failed"]) == failed + 1
    return held_s


def _detect_again(subject: Subject, sender: Sender) -> None:
    subject.bring_to("active")
    sender.send_whole()
