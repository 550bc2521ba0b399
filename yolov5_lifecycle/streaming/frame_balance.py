"""Frame balance: the number of frames per outcome."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import Enum


class Outcome(Enum):
    """The final outcome of a received frame; each frame has exactly one."""

    DETECTED = "detected"
    """Its detections were published."""
    STALE = "stale"
    """A newer frame arrived before the worker was free."""
    REJECTED = "rejected"
    """It was not a readable image."""
    FAILED = "failed"
    """Inference raised an error, or hung and was abandoned."""
    INACTIVE = "inactive"
    """It arrived while detection was stopped."""
    SKIPPED = "skipped"
    """max_rate dropped it."""
    FLUSHED = "flushed"
    """It was still waiting when detection stopped."""


@dataclass(frozen=True)
class FrameBalance:
    """Counts since the process started: `received` is always the sum of the outcomes and `pending`."""

    received: int
    pending: int
    outcomes: dict[Outcome, int]

    def __getitem__(self, outcome: Outcome) -> int:
        return self.outcomes[outcome]


class FrameCounter:
    """Counts received and finished frames; not thread-safe, the owner holds a lock."""

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
