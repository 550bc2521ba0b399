"""Worker: one long-lived inference thread with a rate limit and a slot for the newest frame."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_statistics import FrameBalance, FrameCounter, Outcome

Frame = TypeVar("Frame")
Result = TypeVar("Result")
AnyFrame = TypeVar("AnyFrame", contravariant=True)

MAX_ABANDONED_THREADS = 3
"""Each holds the memory of its model and image; beyond this limit, restart the process."""


class Pipeline(Protocol[AnyFrame, Result]):
    """What the worker does with a frame, in its thread."""

    def detect(self, frame: AnyFrame) -> Result:
        """The result for `frame`. Raises ImageError when the frame is unreadable."""

    def publish(self, result: Result) -> None:
        """Publish what `detect` returned; not called for a frame that was abandoned."""


class RateLimit:
    """Admits at most `max_rate_hz` events per second on average; 0 admits all."""

    def __init__(self, max_rate_hz: float) -> None:
        self.max_rate_hz = max_rate_hz
        self._due_s = 0.0

    def admits(self, now_s: float) -> bool:
        """Whether the event at `now_s` (monotonic seconds) is within the limit.

        It keeps a schedule, not a minimum gap: 20 Hz out of a 30 Hz stream gives 20, not 15.
        """
        if self.max_rate_hz <= 0:
            return True
        if now_s < self._due_s:
            return False
        self._due_s = max(self._due_s + 1 / self.max_rate_hz, now_s)
        return True


class Worker(Generic[Frame, Result]):
    """Runs a pipeline on the newest frame, one at a time, always in the same thread.

    Torch keeps a thread pool and warm caches per calling thread, so the thread survives every start and stop.
    Only a hung thread is abandoned: its frame counts as failed, its late result is dropped, and a new thread
    takes over. An abandoned thread ends when its frame does.

    `on_failure(outcome, error)` and `on_success()` are called in the worker's thread after a frame has been
    counted. `clock` returns monotonic seconds.
    """

    def __init__(
        self,
        *,
        on_failure: Callable[[Outcome, Exception], None],
        on_success: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._on_failure = on_failure
        self._on_success = on_success
        self._clock = clock
        self._changed = threading.Condition()
        self._counter = FrameCounter()
        self._pipeline: Pipeline[Frame, Result] | None = None
        self._rate_limit = RateLimit(0.0)
        self._slot: Frame | None = None
        self._busy = False
        self._begun_s = 0.0
        self._publishing = False
        self._jobs_done = 0
        self._closed = False
        self._abandoned: list[threading.Thread] = []
        self._thread = self._new_thread()
        self._thread.start()

    def start(self, pipeline: Pipeline[Frame, Result], *, max_rate_hz: float = 0.0) -> None:
        """Start with `pipeline` and `max_rate_hz`, or switch to them from the next frame on; 0: no limit."""
        with self._changed:
            self._pipeline = pipeline
            if max_rate_hz != self._rate_limit.max_rate_hz:
                self._rate_limit = RateLimit(max_rate_hz)

    def offer(self, frame: Frame) -> None:
        """Submit a frame; it replaces a waiting one, unless the rate limit drops it."""
        with self._changed:
            self._counter.receive()
            if self._pipeline is None:
                self._counter.finish(Outcome.INACTIVE)
            elif not self._rate_limit.admits(self._clock()):
                self._counter.finish(Outcome.SKIPPED)
            else:
                if self._slot is not None:
                    self._counter.finish(Outcome.STALE)
                self._slot = frame
                self._changed.notify_all()

    def stop(self, timeout_s: float) -> bool:
        """Stop after the current frame and flush the waiting one; True when the thread went idle in time.

        False: the thread hung. It was abandoned and a new one is ready for the next start.
        """
        with self._changed:
            self._pipeline = None
            self._rate_limit = RateLimit(0.0)
            if self._slot is not None:
                self._slot = None
                self._counter.finish(Outcome.FLUSHED)
            rested = self._changed.wait_for(lambda: not self._busy, timeout_s)
            if not rested:
                # A publish in progress cannot be cancelled; publishing never takes long.
                self._changed.wait_for(lambda: not self._publishing)
                rested = not self._busy
            if not rested:
                self._counter.finish(Outcome.FAILED)
                self._busy = False
                self._abandoned = [*self._alive_abandoned(), self._thread]
                self._thread = self._new_thread()
                self._thread.start()
            return rested

    def rest(self, timeout_s: float) -> bool:
        """Wait until the current frame, if any, is finished; False on timeout."""
        with self._changed:
            jobs_done = self._jobs_done
            return self._changed.wait_for(lambda: not self._busy or self._jobs_done > jobs_done, timeout_s)

    def close(self, timeout_s: float) -> bool:
        """Stop and end the thread; True when it and all abandoned threads have ended."""
        self.stop(timeout_s)
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)
        return not any(thread.is_alive() for thread in (self._thread, *self._abandoned))

    def balance(self) -> FrameBalance:
        """A consistent snapshot of all counts."""
        with self._changed:
            return self._counter.balance()

    def busy_s(self) -> float:
        """Seconds since processing of the current frame began; 0 when idle."""
        with self._changed:
            return self._clock() - self._begun_s if self._busy else 0.0

    def abandoned_threads(self) -> int:
        """Number of abandoned threads still processing their frame."""
        with self._changed:
            return len(self._alive_abandoned())

    def _alive_abandoned(self) -> list[threading.Thread]:
        return [thread for thread in self._abandoned if thread.is_alive()]

    def _new_thread(self) -> threading.Thread:
        return threading.Thread(target=self._run, name="inference", daemon=True)

    def _run(self) -> None:
        while (job := self._next_job()) is not None:
            self._work(*job)

    def _is_abandoned(self) -> bool:
        return threading.current_thread() is not self._thread

    def _next_job(self) -> tuple[Pipeline[Frame, Result], Frame] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._slot is not None or self._closed or self._is_abandoned())
            if self._closed or self._is_abandoned() or self._slot is None or self._pipeline is None:
                return None
            frame, self._slot = self._slot, None
            self._busy = True
            self._begun_s = self._clock()
            return self._pipeline, frame

    def _work(self, pipeline: Pipeline[Frame, Result], frame: Frame) -> None:
        error: Exception | None = None
        outcome = Outcome.DETECTED
        try:
            result = pipeline.detect(frame)
            if not self._may_publish():
                return
            pipeline.publish(result)
        except ImageError as unreadable:
            outcome, error = Outcome.REJECTED, unreadable
        except Exception as failure:  # noqa: BLE001 - counted and reported; the next frame is processed
            outcome, error = Outcome.FAILED, failure
        if self._finish(outcome):
            self._report(outcome, error)

    def _may_publish(self) -> bool:
        with self._changed:
            if self._is_abandoned():
                return False
            self._publishing = True
            return True

    def _finish(self, outcome: Outcome) -> bool:
        with self._changed:
            if self._is_abandoned():
                return False
            self._counter.finish(outcome)
            self._jobs_done += 1
            self._busy = self._publishing = False
            self._changed.notify_all()
            return True

    def _report(self, outcome: Outcome, error: Exception | None) -> None:
        if error is None:
            self._on_success()
        else:
            self._on_failure(outcome, error)
