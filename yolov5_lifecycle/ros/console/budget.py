"""Limits on how often something may happen."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable

_MAX_KEYS = 1_000


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


class Budgets:
    """A budget for each address or name; only a thousand recently used ones are kept."""

    def __init__(self, make: Callable[[], Budget]) -> None:
        self._make = make
        self._budgets: OrderedDict[str, Budget] = OrderedDict()

    def of(self, key: str) -> Budget:
        budget = self._budgets.pop(key, None) or self._make()
        self._budgets[key] = budget
        if len(self._budgets) > _MAX_KEYS:
            self._budgets.popitem(last=False)
        return budget
