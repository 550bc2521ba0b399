"""Statistics of frames: their number per outcome, consecutive ones without detections, rate and latencies."""

from __future__ import annotations

import statistics
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass
from enum import Enum

_MIN_SPAN_S = 1e-3  # minimum time span for a meaningful rate


class Outcome(Enum):
    """The final outcome of a received frame; each frame has exactly one."""

    DETECTED = "detected"
    """Its detections were published."""
    STALE = "stale"
    """A newer frame arrived before an inference thread was free."""
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


class FrameCounter:
    """Counts received and finished frames, in any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._received = 0
        self._outcomes: Counter[Outcome] = Counter()

    def receive(self) -> None:
        with self._lock:
            self._received += 1

    def finish(self, outcome: Outcome) -> None:
        with self._lock:
            self._outcomes[outcome] += 1

    def balance(self) -> dict[str, int]:
        """A consistent snapshot: `received` is always the sum of the outcomes, by name, and `pending`."""
        with self._lock:
            received = self._received
            outcomes = {outcome.value: self._outcomes[outcome] for outcome in Outcome}
        return {**outcomes, "received": received, "pending": received - sum(outcomes.values())}


@dataclass(frozen=True)
class EmptyRun:
    """The current run of consecutive frames without detections."""

    frames: int = 0
    begun_s: float = 0.0
    ended_s: float = 0.0
    best_missed: float = 0.0
    """The highest score below the threshold, 0 if none was worth reporting."""
    best_filtered: float = 0.0
    """The highest score above the threshold excluded by regions or box size, 0 if none."""

    @property
    def duration_s(self) -> float:
        return self.ended_s - self.begun_s


@dataclass
class EmptyFrames:
    """Counts consecutive frames without detections; one thread adds, any thread may read `run`."""

    run: EmptyRun = EmptyRun()

    def add(self, now_s: float, found: int, *, best_missed: float, best_filtered: float = 0.0) -> None:
        """Add a frame with `found` detections at `now_s` (monotonic seconds)."""
        if found:
            self.run = EmptyRun()
            return
        before = self.run
        self.run = EmptyRun(
            frames=before.frames + 1,
            begun_s=before.begun_s if before.frames else now_s,
            ended_s=now_s,
            best_missed=max(best_missed, before.best_missed),
            best_filtered=max(best_filtered, before.best_filtered),
        )


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
            rate_hz=len(recent) / min(self._window_s, max(now_s - self._begin_s, _MIN_SPAN_S)),
            median_ms=statistics.median(recent),
            p95_ms=recent[min(len(recent) - 1, int(0.95 * len(recent)))],
        )
