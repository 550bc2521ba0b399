"""The frames of one camera, as seen by who offers them."""

from __future__ import annotations

from typing import Generic

from yolov5_lifecycle.streaming.frame_statistics import FrameBalance
from yolov5_lifecycle.streaming.pipeline import Frame, Pipeline, Result
from yolov5_lifecycle.streaming.schedule import Schedule, Slot


class Feed(Generic[Frame, Result]):
    """The frames of one camera; created by `Worker.feed`."""

    def __init__(self, schedule: Schedule[Frame, Result], slot: Slot[Frame, Result]) -> None:
        self._schedule = schedule
        self._changed = schedule.changed
        self._slot = slot

    def start(self, pipeline: Pipeline[Frame, Result], *, max_rate_hz: float = 0.0) -> None:
        """Start with `pipeline` and `max_rate_hz`, or switch to them from the next frame on; 0: no limit.

        Raises RuntimeError after `close`.
        """
        with self._changed:
            if self._slot not in self._schedule.slots:
                raise RuntimeError("the feed is closed; create another one with Worker.feed()")
            self._slot.start(pipeline, max_rate_hz)
            self._changed.notify_all()  # a frame that waits for another network may begin

    def offer(self, frame: Frame) -> None:
        """Submit a frame; it replaces a waiting one, unless the rate limit drops it."""
        with self._changed:
            self._schedule.offer(self._slot, frame)

    def flush(self) -> None:
        """Accept no more frames and flush the waiting one; `stop` waits for the current one."""
        with self._changed:
            self._schedule.stop([self._slot])

    def rest(self, timeout_s: float) -> bool:
        """Wait until the current frame of this feed, if any, has ended; False if it has not in time."""
        with self._changed:
            return self._schedule.wait(self._slot.job, timeout_s)

    def stop(self, timeout_s: float) -> bool:
        """Stop after the current frame of this feed and flush the waiting one; True when it ended in time.

        False: the thread hung. It was abandoned, and a new one serves the other feeds once they have another
        network. The frames of a batch hang together.
        """
        with self._changed:
            self._schedule.stop([self._slot])
            return self._schedule.wait_or_abandon(self._slot.job, timeout_s)

    def close(self) -> None:
        """Let the worker forget this feed; call after `stop`. Frames offered later are INACTIVE."""
        with self._changed:
            self._schedule.stop([self._slot])
            self._schedule.slots.discard(self._slot)

    def balance(self) -> FrameBalance:
        """A consistent snapshot of all counts."""
        with self._changed:
            return self._slot.counter.balance()

    def busy_s(self) -> float:
        """Seconds since processing of the current frame of this feed began; 0 without one."""
        with self._changed:
            job = self._slot.job
            return self._schedule.clock() - job.begun_s if job else 0.0
