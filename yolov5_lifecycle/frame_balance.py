"""What became of every frame."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import Enum


class Outcome(Enum):
    """The one way in which a received frame ended."""

    DETECTED = "detected"
    """Its detections were published."""
    STALE = "stale"
    """A newer frame arrived before the worker was free."""
    REJECTED = "rejected"
    """It was no readable image."""
    FAILED = "failed"
    """Inference raised, or hung and was given up."""
    INACTIVE = "inactive"
    """It arrived while nothing was detecting."""
    SKIPPED = "skipped"
    """max_rate left it out."""
    FLUSHED = "flushed"
    """It was waiting when detection stopped."""


@dataclass(frozen=True)
class FrameBalance:
    """Counts since the process started: `received` is always the sum of the outcomes and `pending`."""

    received: int
    pending: int
    outcomes: dict[Outcome, int]

    def __getitem__(self, outcome: Outcome) -> int:
        return self.outcomes[outcome]


class FrameCounter:
    """Counts frames in and out; not thread-safe, its owner holds a lock."""

    def __init__(self) -> None:
        self._received = 0
        self._outcomes: Counter[Outcome] = Counter()

    def receive(self) -> None:
        self._received += 1

    def finish(self, outcome: Outcome) -> None:
        self._outcomes[outcome] += 1

    def balance(self) -> FrameBalance:
        outcomes = {outcome: self._outcomes[outcome] for outcome in Outcome}
        return FrameBalance(self._received, self._received - sum(outcomes.values()), outcomes)
