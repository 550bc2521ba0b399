"""Hostile images in the way of a running detector."""

from __future__ import annotations

from collections import Counter

from soak.finding import Finding
from soak.hostile_images import MakeImage, damaged_file, damaged_message, hostile_file, hostile_image
from soak.sender import Sender
from soak.service_requests import Fuzz
from soak.subject import Subject

_BATCH = 250


def rejected_images(subject: Subject, count: int, seed: int) -> Finding:
    """Raw images whose fields are wrong."""
    return _all_rejected("every hostile image is rejected", "raw", hostile_image, subject, count, seed)


def rejected_files(subject: Subject, count: int, seed: int) -> Finding:
    """Compressed images that are cut off, foreign or bombs."""
    return _all_rejected(
        "every hostile compressed image is rejected", "compressed", hostile_file, subject, count, seed
    )


def survived_files(subject: Subject, count: int, seed: int) -> Finding:
    """Compressed images with wrong or missing bytes, which a decoder may partly understand."""
    return _survived(
        "every damaged compressed image is survived", "compressed", damaged_file, subject, count, seed
    )


def survived_messages(subject: Subject, count: int, seed: int) -> Finding:
    """Raw images whose message itself is damaged; one that cannot be taken apart is lost on the way."""
    return _survived("every damaged image message is survived", "raw", damaged_message, subject, count, seed)


def _all_rejected(
    claim: str, transport: str, make: MakeImage, subject: Subject, count: int, seed: int
) -> Finding:
    sent, fates = _fates(transport, make, subject, count, seed)
    return Finding(
        claim=claim,
        done=f"{sent} {transport} images, seed {seed}",
        result=_told(sent, fates, subject),
        limit="all rejected, but for stale or lost ones; 0 exceptions",
        is_met=fates.total() == sent
        and fates.keys() <= {"rejected", "stale", "lost"}
        and not subject.escaped,
    )


def _survived(
    claim: str, transport: str, make: MakeImage, subject: Subject, count: int, seed: int
) -> Finding:
    sent, fates = _fates(transport, make, subject, count, seed)
    return Finding(
        claim=claim,
        done=f"{sent} {transport} images with wrong or missing bytes, seed {seed}",
        result=_told(sent, fates, subject),
        limit="0 failed, 0 unaccounted, 0 exceptions",
        is_met=fates.total() == sent and "failed" not in fates and not subject.escaped,
    )


def _fates(
    transport: str, make: MakeImage, subject: Subject, count: int, seed: int
) -> tuple[int, Counter[str]]:
    """How many were sent until `count` were judged, and how many met each fate."""
    subject.reset()
    assert subject.node.set_parameters(image_transport=transport) == ""
    subject.bring_to("active")
    sender, fuzz = Sender(subject, transport), Fuzz(seed)
    sender.send_whole()  # from here on lost ones are noticed
    before, sent_before, whole = _counts(subject), sender.sent, 0
    fates: Counter[str] = Counter()
    while fates["rejected"] + fates["detected"] < count:
        for _ in range(_BATCH):
            sender.send(make(fuzz))
        sender.send_whole()
        whole += 1
        fates = _counts(subject) - before - Counter(detected=whole)
    sender.close()
    subject.reset()
    return sender.sent - sent_before - whole, fates


def _counts(subject: Subject) -> Counter[str]:
    """Frames by fate so far."""
    ends = {key.removeprefix("frames "): value for key, value in subject.status().items() if "frames " in key}
    return Counter({end: int(count) for end, count in ends.items() if end != "received"})


def _told(sent: int, fates: Counter[str], subject: Subject) -> str:
    counts = ", ".join(f"{count} {fate}" for fate, count in fates.most_common())
    return f"{counts}; {sent - fates.total()} unaccounted; {len(subject.escaped)} exceptions"
