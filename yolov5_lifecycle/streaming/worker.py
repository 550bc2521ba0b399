"""Worker: one long-lived inference thread, which serves the cameras in turns."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Generic, NamedTuple

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.feed import Feed, Frame, Job, Result, Schedule, Slot, Turn
from yolov5_lifecycle.streaming.frame_statistics import Outcome

MAX_ABANDONED_THREADS = 3
"""Each holds the memory of its model and image; beyond this limit, restart the process."""


class _Failure(NamedTuple):
    """Why a frame has no published result."""

    outcome: Outcome
    error: Exception


class Worker(Generic[Frame, Result]):
    """Runs pipelines on the newest frames of its feeds, one at a time, always in the same thread.

    Of the feeds with a waiting frame, the one served longest ago is next.

    Torch keeps a thread pool and warm caches per calling thread, so the thread survives every start and stop.
    Only a hung thread is abandoned: its frame counts as failed, its late result is dropped, and a new thread
    takes over. An abandoned thread ends when its frame does.

    `clock` returns monotonic seconds.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._schedule: Schedule[Frame, Result] = Schedule(clock=clock, replace_thread=self._replace_thread)
        self._changed = self._schedule.changed
        self._is_closed = False
        self._abandoned: list[threading.Thread] = []
        self._thread = self._new_thread()
        self._thread.start()

    def feed(
        self, *, on_failure: Callable[[Outcome, Exception], None], on_success: Callable[[], None]
    ) -> Feed[Frame, Result]:
        """A new feed, stopped.

        `on_failure(outcome, error)` and `on_success()` are called in the worker's thread after a frame has
        been counted. They are not called for a frame that was abandoned.
        """
        slot: Slot[Frame, Result] = Slot(on_failure=on_failure, on_success=on_success)
        with self._changed:
            if not self._is_closed:
                self._schedule.slots.add(slot)
        return Feed(self._schedule, slot)

    def rest(self, timeout_s: float) -> bool:
        """Wait until the current job, if any, is finished; False on timeout or if it was abandoned."""
        with self._changed:
            return self._schedule.wait(self._schedule.job, timeout_s)

    def stop(self, timeout_s: float) -> bool:
        """Stop all feeds at once, as `Feed.stop` does; False if a thread hung and was abandoned."""
        with self._changed:
            self._schedule.stop(list(self._schedule.slots))
            return self._schedule.wait_or_abandon(self._schedule.job, timeout_s)

    def close(self, timeout_s: float) -> bool:
        """Stop and close all feeds, end the thread; True when it and all abandoned threads have ended."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
            self._schedule.stop(list(self._schedule.slots))
            self._schedule.slots.clear()
            self._schedule.wait_or_abandon(self._schedule.job, timeout_s)
        self._thread.join(timeout_s)
        return not any(thread.is_alive() for thread in (self._thread, *self._abandoned))

    def abandoned_threads(self) -> int:
        """Number of abandoned threads still processing their frame."""
        with self._changed:
            return len(self._alive_abandoned())

    def _alive_abandoned(self) -> list[threading.Thread]:
        return [thread for thread in self._abandoned if thread.is_alive()]

    def _new_thread(self) -> threading.Thread:
        return threading.Thread(target=self._run, name="inference", daemon=True)

    def _replace_thread(self) -> None:
        self._abandoned = [*self._alive_abandoned(), self._thread]
        self._thread = self._new_thread()
        self._thread.start()

    def _run(self) -> None:
        while (job := self._next_job()) is not None:
            self._work(job)
            del job  # an idle thread holds no frame

    def _next_job(self) -> Job[Frame, Result] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._schedule.has_waiting or self._is_over())
            return None if self._is_over() else self._schedule.begin()

    def _is_over(self) -> bool:
        """Whether the current thread has nothing more to do."""
        return self._is_closed or threading.current_thread() is not self._thread

    def _work(self, job: Job[Frame, Result]) -> None:
        results = [self._detected(turn) for turn in job.turns]
        if not self._may_publish(job):
            return
        failures = [self._published(turn, result) for turn, result in zip(job.turns, results, strict=True)]
        with self._changed:
            self._schedule.finish(job, [_outcome(failure) for failure in failures])
        for turn, failure in zip(job.turns, failures, strict=True):
            _report(turn.slot, failure)

    def _may_publish(self, job: Job[Frame, Result]) -> bool:
        with self._changed:
            job.is_publishing = not job.is_abandoned
            return job.is_publishing

    def _detected(self, turn: Turn[Frame, Result]) -> Result | _Failure:
        try:
            return turn.pipeline.detect(turn.frame)
        except Exception as error:  # noqa: BLE001 - counted and reported; the next frame is processed
            return _failure(error)

    def _published(self, turn: Turn[Frame, Result], result: Result | _Failure) -> _Failure | None:
        """Publish `result`; return why it is not published, None if it is."""
        if isinstance(result, _Failure):
            return result
        try:
            turn.pipeline.publish(result)
        except Exception as error:  # noqa: BLE001 - likewise
            return _failure(error)
        return None


def _failure(error: Exception) -> _Failure:
    return _Failure(Outcome.REJECTED if isinstance(error, ImageError) else Outcome.FAILED, error)


def _outcome(failure: _Failure | None) -> Outcome:
    return Outcome.DETECTED if failure is None else failure.outcome


def _report(slot: Slot[Frame, Result], failure: _Failure | None) -> None:
    if failure is None:
        slot.on_success()
    else:
        slot.on_failure(failure.outcome, failure.error)
