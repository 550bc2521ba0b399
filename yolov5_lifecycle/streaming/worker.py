"""Worker: one long-lived inference thread, which serves the cameras in turn."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Generic

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.feed import Feed, Job, Schedule, Slot, Turn
from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.streaming.pipeline import Batch, Frame, Result

MAX_ABANDONED_THREADS = 3
"""Each holds the memory of its model and image; beyond this limit, restart the process."""


class Worker(Generic[Frame, Result]):
    """Runs pipelines on the newest frames of its feeds, one at a time, always in the same thread.

    Of the feeds with a waiting frame, the one served longest ago is next.

    Torch keeps a thread pool and warm caches per calling thread, so the thread survives every start and stop.
    Only a hung thread is abandoned: its frame counts as failed unless its detections were sent, what it has
    not sent is dropped, and a new thread takes over. An abandoned thread ends when its frame does; until then
    it keeps its network, and frames for the same network wait.

    `clock` returns monotonic seconds.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._schedule: Schedule[Frame, Result] = Schedule(clock=clock, replace_thread=self._replace_thread)
        self._changed = self._schedule.changed
        self.batch: Batch[Frame, Result] | None = None
        """Runs frames that wait at the same time together, from the next job on; None: each runs alone."""
        self._is_closed = False
        self._abandoned: list[threading.Thread] = []
        self._thread = self._new_thread()
        self._thread.start()

    def feed(
        self, *, on_failure: Callable[[Outcome, Exception], None], on_success: Callable[[], None]
    ) -> Feed[Frame, Result]:
        """A new feed, stopped.

        The worker's thread calls `on_failure(outcome, error)` or `on_success()` after it has counted a frame,
        except for a frame that was abandoned.
        """
        slot: Slot[Frame, Result] = Slot(on_failure=on_failure, on_success=on_success)
        with self._changed:
            if not self._is_closed:
                self._schedule.slots.add(slot)
        return Feed(self._schedule, slot)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """In the block no frame begins; the one in progress goes on."""
        with self._changed:
            self._schedule.pauses += 1
        try:
            yield
        finally:
            with self._changed:
                self._schedule.pauses -= 1
                self._changed.notify_all()

    def is_at_rest(self) -> bool:
        """Whether no frame is in progress."""
        with self._changed:
            return self._schedule.job is None

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

    def keeps(self, network: object) -> bool:
        """Whether an abandoned thread keeps `network`, so that no frame with it begins."""
        with self._changed:
            return self._schedule.keeps(network)

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
        while (next_job := self._next_job()) is not None:
            job, batch = next_job
            if batch is None or len(job.turns) == 1:
                self._work(job)
            else:
                self._work_together(job, batch)
            del job, batch, next_job  # an idle thread holds no frame

    def _next_job(self) -> tuple[Job[Frame, Result], Batch[Frame, Result] | None] | None:
        with self._changed:
            while not self._schedule.ready() and not self._is_over():
                self._changed.wait()
            batch = self.batch
            return None if self._is_over() else (self._schedule.begin(batch), batch)

    def _is_over(self) -> bool:
        """Whether the current thread has nothing more to do."""
        return self._is_closed or threading.current_thread() is not self._thread

    def _work(self, job: Job[Frame, Result]) -> None:
        (turn,) = job.turns
        try:
            result = turn.pipeline.detect(turn.frame)
        except Exception as error:  # noqa: BLE001 - counted and reported; the next frame is processed
            turn.fail(_outcome(error), error)
        else:
            self._publish(job, turn, result)
        self._end(job)

    def _work_together(self, job: Job[Frame, Result], batch: Batch[Frame, Result]) -> None:
        try:
            results = _detected(batch, job)
        except Exception as error:  # noqa: BLE001 - likewise
            for turn in job.turns:
                turn.fail(Outcome.FAILED, error)
        else:
            for turn, result in zip(job.turns, results, strict=True):
                self._publish(job, turn, result)
        self._end(job)

    def _publish(
        self, job: Job[Frame, Result], turn: Turn[Frame, Result], result: Result | Exception
    ) -> None:
        """Compute and send the messages of `result`, until `job` is abandoned."""
        if job.is_abandoned:
            return
        try:
            if isinstance(result, Exception):
                raise result
            for send in turn.pipeline.messages(result):
                if not self._may_send(job, turn):
                    return
                send()
        except Exception as error:  # noqa: BLE001 - likewise
            turn.fail(_outcome(error), error)

    def _may_send(self, job: Job[Frame, Result], turn: Turn[Frame, Result]) -> bool:
        with self._changed:
            turn.has_sent |= not job.is_abandoned
            return not job.is_abandoned

    def _end(self, job: Job[Frame, Result]) -> None:
        with self._changed:
            self._schedule.end(job)
        if not job.is_abandoned:
            for turn in job.turns:
                turn.report()


def _outcome(error: Exception) -> Outcome:
    return Outcome.REJECTED if isinstance(error, ImageError) else Outcome.FAILED


def _detected(batch: Batch[Frame, Result], job: Job[Frame, Result]) -> Sequence[Result | Exception]:
    """One result for each turn of `job`; raises ValueError if `batch` returns another number of them."""
    results = batch.detect([(turn.pipeline, turn.frame) for turn in job.turns])
    if len(results) != len(job.turns):
        raise ValueError(
            f"a batch of {len(job.turns)} frames returned {len(results)} results; expected one each"
        )
    return results
