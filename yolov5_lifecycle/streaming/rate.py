"""Rate limiting, and rate and latency statistics."""

from __future__ import annotations

import statistics
import time
from collections import deque
from dataclasses import dataclass

_LEAST_S = 1e-3  # minimum time span for a meaningful rate


class RateLimit:
    """Admits at most `max_rate_hz` events per second on average; 0 admits all."""

    def __init__(self) -> None:
        self._due_s = 0.0

    def admits(self, now_s: float, max_rate_hz: float) -> bool:
        """Whether the event at `now_s` (monotonic seconds) is within the limit.

        It keeps a schedule, not a minimum gap: 20 Hz out of a 30 Hz stream gives 20, not 15.
        """
        if max_rate_hz <= 0:
            return True
        if now_s < self._due_s:
            return False
        self._due_s = max(self._due_s + 1 / max_rate_hz, now_s)
        return True


@dataclass(frozen=True)
class LatencySummary:
    """Events per second and latencies in ms (NaN without events) over the window."""

    rate_hz: float
    median_ms: float
    p95_ms: float


class LatencyWindow:
    """Latencies of the last `window_s` seconds, counted from `begin_s` (monotonic, default: now).

    One thread adds, any thread may read.
    """

    def __init__(self, window_s: float = 5.0, *, begin_s: float | None = None) -> None:
        self._window_s = window_s
        self._begin_s = time.monotonic() if begin_s is None else begin_s
        self._events: deque[tuple[float, float]] = deque(maxlen=4096)

    def add(self, now_s: float, latency_ms: float) -> None:
        self._events.append((now_s, latency_ms))

    def summary(self, now_s: float) -> LatencySummary:
        """Rate and latencies between `now_s - window_s` and `now_s`."""
        recent = sorted(ms for at_s, ms in tuple(self._events) if now_s - at_s <= self._window_s)
        if not recent:
            return LatencySummary(0.0, float("nan"), float("nan"))
        return LatencySummary(
            rate_hz=len(recent) / min(self._window_s, max(now_s - self._begin_s, _LEAST_S)),
            median_ms=statistics.median(recent),
            p95_ms=recent[min(len(recent) - 1, int(0.95 * len(recent)))],
        )
