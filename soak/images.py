"""Hostile images sent to a running detector."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import dataclass

from soak.finding import Finding, number_of
from soak.hostile_images import (
    MakeImage,
    costly_file,
    damaged_file,
    damaged_message,
    hostile_file,
    hostile_image,
)
from soak.sender import Sender
from soak.service_requests import Fuzz
from soak.subject import Subject

_BATCH = 250


def rejected_images(subject: Subject, count: int, seed: int) -> Finding:
    """Send raw images with invalid fields; all must be rejected."""
    return _all_rejected("every hostile image is rejected", "raw", hostile_image, subject, count, seed)


def rejected_files(subject: Subject, count: int, seed: int) -> Finding:
    """Send compressed images that are truncated, of another format, or decompression bombs."""
    return _all_rejected(
        "every hostile compressed image is rejected", "compressed", hostile_file, subject, count, seed
    )


def rejected_costly_files(subject: Subject, count: int, seed: int) -> Finding:
    """Send compressed images that hide their size, or take much memory or time to decode."""
    return _all_rejected(
        "every image that hides what it costs is rejected", "compressed", costly_file, subject, count, seed
    )


def survived_files(subject: Subject, count: int, seed: int) -> Finding:
    """Send compressed images with wrong or missing bytes, which a decoder may partly read."""
    return _survived(
        "every damaged compressed image is survived", "compressed", damaged_file, subject, count, seed
    )


def survived_messages(subject: Subject, count: int, seed: int) -> Finding:
    """Send raw images whose serialized message is damaged; undeserializable ones are lost."""
    return _survived("every damaged image message is survived", "raw", damaged_message, subject, count, seed)


@dataclass(frozen=True)
class _Fates:
    """Images sent to the subject and their outcomes."""

    hostile: int
    whole: int
    counts: Counter[str]
    escaped: list[str]

    @property
    def unaccounted(self) -> int:
        return self.hostile + self.whole - self.counts.total()

    def __str__(self) -> str:
        counts = ", ".join(f"{count} {fate}" for fate, count in self.counts.most_common())
        return f"{counts}; {self.unaccounted} unaccounted; {number_of('exceptions', self.escaped)}"


def _all_rejected(
    claim: str, transport: str, make: MakeImage, subject: Subject, count: int, seed: int
) -> Finding:
    fates = _fates(transport, make, subject, count, seed)
    are_rejected = fates.counts.keys() <= {"rejected", "detected", "stale", "lost", "overtaken"}
    return Finding(
        claim=claim,
        done=f"{fates.hostile} {transport} images and {fates.whole} whole ones, seed {seed}",
        result=str(fates),
        limit="whole ones detected, others rejected, stale, overtaken or lost; 0; 0",
        is_met=are_rejected
        and fates.counts["detected"] <= fates.whole
        and not fates.unaccounted
        and not fates.escaped,
    )


def _survived(
    claim: str, transport: str, make: MakeImage, subject: Subject, count: int, seed: int
) -> Finding:
    fates = _fates(transport, make, subject, count, seed)
    return Finding(
        claim=claim,
        done=f"{fates.hostile} {transport} images with wrong or missing bytes, seed {seed}",
        result=str(fates),
        limit="none failed; 0; 0",
        is_met=not fates.counts["failed"] and not fates.unaccounted and not fates.escaped,
    )


def _fates(transport: str, make: MakeImage, subject: Subject, count: int, seed: int) -> _Fates:
    """Send hostile images until `count` have an outcome, with valid ones in between."""
    subject.reset()
    assert subject.node.set_parameters(image_transport=transport) == ""
    subject.bring_to("active")
    fuzz, hostile, counts = Fuzz(seed), 0, Counter[str]()
    with closing(Sender(subject, transport)) as sender:
        sender.wait_until_reliable()
        sender.send_whole()  # from here on lost images are counted
        before, sender.whole = _counts(subject), 0
        while counts["rejected"] + counts["detected"] - sender.whole < count:
            for _ in range(_BATCH):
                sender.send(make(fuzz))
            hostile += _BATCH
            sender.send_whole()
            counts = _counts(subject) - before
    subject.reset()
    return _Fates(hostile, sender.whole, counts, subject.escaped)


def _counts(subject: Subject) -> Counter[str]:
    """Frames by outcome so far."""
    prefix = "frames "
    ends = {key.removeprefix(prefix): value for key, value in subject.status().items() if prefix in key}
    return Counter({end: int(count) for end, count in ends.items() if end != "received"})
