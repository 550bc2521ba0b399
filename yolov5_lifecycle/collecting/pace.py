"""How often frames of one camera may be kept."""

from __future__ import annotations

import math


class Pace:
    """At most one frame every `gap_s`, and `per_minute` in each minute, 0 for no limit.

    Asked by the inference thread, told by the thread that keeps frames; times are monotonic seconds.
    """

    def __init__(self) -> None:
        self._last_s = -math.inf
        self._credit = math.inf
        """Frames that may be kept at `_last_s`; infinite before the first."""

    def allows(self, now_s: float, *, gap_s: float, per_minute: float) -> bool:
        """Whether a frame may be kept now."""
        if now_s - self._last_s < gap_s:
            return False
        return not per_minute or self._credit_at(now_s, per_minute) >= 1

    def kept(self, now_s: float, *, per_minute: float) -> None:
        """Count a frame that was kept."""
        self._credit = max(self._credit_at(now_s, per_minute) - 1, 0) if per_minute else math.inf
        self._last_s = now_s

    def _credit_at(self, now_s: float, per_minute: float) -> float:
        """Frames that may be kept: those of a minute at most, and again as many with each minute."""
        earned = (now_s - self._last_s) * per_minute / 60
        return min(self._credit + earned, max(per_minute, 1))
