"""Inference that fails, hangs or loses its device, in the real node with the real model."""

from __future__ import annotations

import time
from array import array

from sensor_msgs.msg import Image

from soak.faulty_detector import GREYS
from soak.finding import Finding, none_wrong, number_of, problem
from soak.sender import Sender
from soak.subject import Subject, subject
from yolov5_lifecycle.ros.detector.node import EXIT_ABANDONED_SESSIONS, EXIT_DEVICE_LOST
from yolov5_lifecycle.ros.detector.session import MAX_ABANDONED_SESSIONS, REST_TIMEOUT_S

_FAILING = ("raise", "out of memory", "NaN", "wrong shape")
_SIDE_PX = 320
_END_S = 10.0
_RETURN_S = REST_TIMEOUT_S + 1


def survived_faults(subject: Subject, count: int, *, is_timed: bool = True) -> Finding:
    """Repeat every fault except device loss in one process; the duration of deactivate is only judged if
    `is_timed`."""
    subject.reset()
    subject.bring_to("active")
    sender, held_s = Sender(subject, "raw"), 0.0
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


def ended_by_lost_devices(count: int) -> Finding:
    """Lose the device in `count` processes, one after the other."""
    return none_wrong(
        "a lost device ends the process with its own code",
        f"{count} processes",
        "other ends",
        [*filter(None, (problem(_lose_device) for _ in range(count)))],
        limit=f"0; exit code {EXIT_DEVICE_LOST} within {_END_S:g} s",
    )


def ended_by_abandoned_threads(count: int) -> Finding:
    """Hang inference repeatedly in each of `count` processes."""
    return none_wrong(
        "too many hung inference threads end the process with its own code",
        f"{count} processes, {MAX_ABANDONED_SESSIONS + 1} hangs each",
        "other ends",
        [*filter(None, (problem(_abandon_threads) for _ in range(count)))],
        limit=f"0; exit code {EXIT_ABANDONED_SESSIONS} within {_END_S:g} s",
    )


def faulty_image(kind: str) -> Image:
    """An image that makes inference of the subject fail."""
    data = array("B", bytes([GREYS[kind]]) * (3 * _SIDE_PX**2))
    return Image(height=_SIDE_PX, width=_SIDE_PX, encoding="rgb8", step=3 * _SIDE_PX, data=data)


def _abandon_threads() -> None:
    with subject() as process:
        for abandoned in range(MAX_ABANDONED_SESSIONS + 1):
            process.bring_to("active")
            assert process.status()["abandoned threads"] == str(abandoned)
            sender = Sender(process, "raw")
            sender.send_whole()
            sender.send(faulty_image("long hang"))
            process.observer.wait_for(lambda: process.status()["frames pending"] == "1", "inference to hang")
            assert process.transition("deactivate")
            sender.close()
        code = process.process.wait(_END_S)
        assert code == EXIT_ABANDONED_SESSIONS, f"exit code {code}"


def _lose_device() -> None:
    with subject() as process:
        process.bring_to("active")
        sender = Sender(process, "raw")
        # By then the node has resubscribed for the last time; it misses images sent while it does so.
        process.observer.wait_for(
            lambda: process.status()["image reliability"] == "reliable", "a reliable subscription"
        )
        sender.send_whole()
        sender.send(faulty_image("device lost"))
        code = process.process.wait(_END_S)
        assert code == EXIT_DEVICE_LOST, f"exit code {code}"


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
    sender.wait_until_heard()
    sender.send_whole()
