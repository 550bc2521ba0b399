"""A limit on how often something may happen."""

from __future__ import annotations

import time
from collections.abc import Callable

MAX_ADDRESSES = 1_000
"""Those used recently, each of which has a budget."""


class Budget:
    """At most `burst` at once and `rate_hz` in the long run."""

    def __init__(self, rate_hz: float, burst: float, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._rate_hz = rate_hz
        self._burst = burst
        self._clock = clock
        self._left = burst
        self._since_s = clock()

    def spend(self) -> bool:
        """Whether it may happen now; if so, it counts."""
        now_s = self._clock()
        self._left = min(self._burst, self._left + (now_s - self._since_s) * self._rate_hz)
        self._since_s = now_s
        if self._left < 1:
            return False
        self._left -= 1
        return True
