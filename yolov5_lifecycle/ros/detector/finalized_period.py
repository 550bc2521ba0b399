"""Time for which a finalized node answers services before its process ends."""

from __future__ import annotations

import time
from collections.abc import Callable

FINALIZED_S = 5.0
"""Longer than a lifecycle manager waits for get_state; Nav2's waits up to 2 s."""


class FinalizedPeriod:
    """Timer that starts when a node is first seen finalized and runs for `duration_s` seconds.

    `announce` is called once, with a log message, when the timer starts. `clock` returns monotonic seconds.
    """

    def __init__(
        self,
        *,
        announce: Callable[[str], object],
        duration_s: float = FINALIZED_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._announce = announce
        self._duration_s = duration_s
        self._clock = clock
        self._end_s: float | None = None

    def is_over(self, state: str) -> bool:
        """Whether the period is over for a node in the lifecycle state `state`."""
        if state != "finalized":
            return False
        if self._end_s is None:
            self._end_s = self._clock() + self._duration_s
            self._announce(f"finalized: everything is released, the process ends in {self._duration_s:g} s")
        return self._clock() >= self._end_s
