"""Counter of consecutive frames without detections."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EmptyRun:
    """The current run of consecutive frames in which nothing scored above `threshold`."""

    threshold: float
    frames: int = 0
    begun_s: float = 0.0
    ended_s: float = 0.0
    best_missed: float = 0.0
    """The highest score below the threshold, 0 if none was worth reporting."""

    @property
    def duration_s(self) -> float:
        return self.ended_s - self.begun_s


_NONE = EmptyRun(threshold=0.0)


@dataclass
class EmptyFrames:
    """Counts consecutive frames without detections; one thread adds, any thread may read `run`."""

    threshold: float
    run: EmptyRun = _NONE

    def add(self, now_s: float, found: int, best_missed: float) -> None:
        """Add a frame with `found` detections at `now_s` (monotonic seconds)."""
        if found:
            self.run = EmptyRun(self.threshold)
        else:
            begun_s = self.run.begun_s if self.run.frames else now_s
            best_missed = max(best_missed, self.run.best_missed)
            self.run = EmptyRun(self.threshold, self.run.frames + 1, begun_s, now_s, best_missed)
