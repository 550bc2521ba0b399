"""Worker: the inference threads, which serve the cameras in turn."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Generic

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_statistics import FrameBalance, Outcome
from yolov5_lifecycle.streaming.pipeline import Frame, Pipeline, Result
from yolov5_lifecycle.streaming.schedule import Job, Schedule, Slot

MAX_ABANDONED_THREADS = 3
"""Each holds the memory of its model and image; beyond this limit, restart the process."""


class Worker(Generic[Frame, Result]):
    """Runs pipelines on the newest frames of its feeds: frames of one camera one after the other, of
    different cameras at the same time if their networks allow it.

    Of the feeds with a waiting frame, the one served longest ago is next.

    Torch keeps a thread pool and warm caches per calling thread, so threads survive every start and stop.
    Only a hung thread is abandoned: its frame counts as failed unless its detections were sent, what it has
    not sent is dropped, and a new thread takes over. An abandoned thread ends when its frame does; its
    network is not used again.

    `clock` returns monotonic seconds.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._schedule: Schedule[Frame, Result] = Schedule(clock=clock, on_abandoned=self._abandon_lane_of)
        self._lock = self._schedule.lock
        self._is_closed = False
        self._lanes: list[Lane[Frame, Result]] = []
        self._idle: list[Lane[Frame, Result]] = []
        """Those without a job; the last one, whose caches are the warmest, is next."""
        self._abandoned: list[Lane[Frame, Result]] = []
        with self._lock:
            self._add_lane()

    def feed(
        self, *, on_failure: Callable[[Outcome, Exception], None], on_success: Callable[[], None]
    ) -> Feed[Frame, Result]:
        """A new feed, stopped.

        An inference thread calls `on_failure(outcome, error)` or `on_success()` after it has counted a frame,
        except for a frame that was abandoned.
        """
        slot: Slot[Frame, Result] = Slot(on_failure=on_failure, on_success=on_success)
        with self._lock:
            if not self._is_closed:
                self._schedule.slots.add(slot)
        return Feed(self, self._schedule, slot)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """In the block no frame begins; those in progress go on."""
        with self._lock:
            self._schedule.pauses += 1
        try:
            yield
        finally:
            with self._lock:
                self._schedule.pauses -= 1
                self.begin_jobs()

    def is_at_rest(self) -> bool:
        """Whether no frame is in progress."""
        with self._lock:
            return not self._schedule.jobs

    def rest(self, timeout_s: float) -> bool:
        """Wait until all current jobs are finished; False on timeout or if one was abandoned."""
        with self._lock:
            return self._schedule.wait([*self._schedule.jobs], timeout_s)

    def stop(self, timeout_s: float) -> bool:
        """Stop all feeds after the frames in progress; False if a thread hung and was abandoned."""
        with self._lock:
            return self._stop(timeout_s)

    def close(self, timeout_s: float) -> bool:
        """Stop and close all feeds, end the threads; True when they and all abandoned ones have ended."""
        with self._lock:
            self._is_closed = True
            self._stop(timeout_s)
            self._schedule.slots.clear()
            lanes = [*self._lanes, *self._abandoned]
            for lane in lanes:
                lane.end()
        end_s = time.monotonic() + timeout_s
        for lane in lanes:
            lane.thread.join(max(0.0, end_s - time.monotonic()))
        return not any(lane.thread.is_alive() for lane in lanes)

    def _stop(self, timeout_s: float) -> bool:
        self._schedule.stop(self._schedule.slots)
        return self._schedule.wait_or_abandon([*self._schedule.jobs], timeout_s)

    def abandoned_threads(self) -> int:
        """Number of abandoned threads still processing their frame."""
        with self._lock:
            return sum(lane.thread.is_alive() for lane in self._abandoned)

    def add_lanes(self, count: int) -> None:
        """Have at least `count` threads; hold the lock. Raises RuntimeError if the system refuses another."""
        while len(self._lanes) < count and not self._is_closed:
            self._add_lane()

    def begin_jobs(self) -> None:
        """Begin every job that may begin now; hold the lock, whenever something has changed."""
        while self._idle and (job := self._schedule.begin()) is not None:
            self._idle.pop().give(job)

    def _add_lane(self) -> None:
        lane: Lane[Frame, Result] = Lane(self._lock, end=self._end)
        lane.thread.start()
        self._lanes.append(lane)
        self._idle.append(lane)

    def _abandon_lane_of(self, job: Job[Frame, Result]) -> None:
        (lane,) = [lane for lane in self._lanes if lane.job is job]
        self._lanes.remove(lane)
        self._abandoned = [*(each for each in self._abandoned if each.thread.is_alive()), lane]
        lane.end()
        if not self._is_closed:
            self._add_lane()
            self.begin_jobs()

    def _end(self, lane: Lane[Frame, Result], job: Job[Frame, Result]) -> None:
        """Count and report the frame of `job`, in the thread of `lane`, which is idle then."""
        with self._lock:
            self._schedule.end(job)
            lane.job = None
        if not job.is_abandoned:
            job.report()
        with self._lock:
            if lane in self._lanes:
                self._idle.append(lane)
            self.begin_jobs()


class Lane(Generic[Frame, Result]):
    """An inference thread, not started: does the jobs it is given, until `end`.

    Whoever holds `lock`, that of the worker's schedule, calls its methods. The thread calls `end(lane, job)`
    after each job.
    """

    def __init__(
        self,
        lock: threading.RLock,
        *,
        end: Callable[[Lane[Frame, Result], Job[Frame, Result]], None],
    ) -> None:
        self.job: Job[Frame, Result] | None = None
        """In progress."""
        self.thread = threading.Thread(target=self._run, name="inference", daemon=True)
        self._lock = lock
        self._end_job = end
        self._given = threading.Condition(lock)
        self._is_over = False

    def give(self, job: Job[Frame, Result]) -> None:
        """Begin `job`; the lane is idle."""
        self.job = job
        self._given.notify()

    def end(self) -> None:
        """Let the thread end after its job, if it has one."""
        self._is_over = True
        self._given.notify()

    def _run(self) -> None:
        while (job := self._next_job()) is not None:
            self._work(job)
            self._end_job(self, job)
            del job  # an idle thread holds no frame

    def _next_job(self) -> Job[Frame, Result] | None:
        with self._lock:
            while self.job is None and not self._is_over:
                self._given.wait()
            return self.job

    def _work(self, job: Job[Frame, Result]) -> None:
        """Detect in the frame of `job`, compute and send its messages, until it is abandoned."""
        try:
            result = job.pipeline.detect(job.frame, job.network)
            if job.is_abandoned:
                return
            for send in job.pipeline.messages(result):
                if not self._may_send(job):
                    return
                send()
        except Exception as error:  # noqa: BLE001 - counted and reported; the next frame is processed
            job.fail(_outcome(error), error)

    def _may_send(self, job: Job[Frame, Result]) -> bool:
        with self._lock:
            job.has_sent |= not job.is_abandoned
            return not job.is_abandoned


class Feed(Generic[Frame, Result]):
    """The frames of one camera; created by `Worker.feed`."""

    def __init__(
        self, worker: Worker[Frame, Result], schedule: Schedule[Frame, Result], slot: Slot[Frame, Result]
    ) -> None:
        self._worker = worker
        self._schedule = schedule
        self._lock = schedule.lock
        self._slot = slot

    def start(self, pipeline: Pipeline[Frame, Result], *, max_rate_hz: float = 0.0) -> None:
        """Start with `pipeline` and `max_rate_hz`, or switch to them from the next frame on; 0: no limit.

        Raises RuntimeError after `close`, or if a thread is needed that the system refuses.
        """
        with self._lock:
            if self._slot not in self._schedule.slots:
                raise RuntimeError("the feed is closed; create another one with Worker.feed()")
            self._worker.add_lanes(len(pipeline.networks.parallel))
            self._slot.start(pipeline, max_rate_hz)
            self._worker.begin_jobs()  # a frame that waits for another network may begin

    def offer(self, frame: Frame) -> None:
        """Submit a frame; it replaces a waiting one, unless the rate limit drops it."""
        with self._lock:
            self._schedule.offer(self._slot, frame)
            self._worker.begin_jobs()

    def close(self) -> None:
        """Let the worker forget this feed; call when it is stopped. Frames offered later are INACTIVE."""
        with self._lock:
            self._schedule.stop([self._slot])
            self._schedule.slots.discard(self._slot)

    def balance(self) -> FrameBalance:
        """A consistent snapshot of all counts."""
        with self._lock:
            return self._slot.counter.balance()

    def busy_s(self) -> float:
        """Seconds since processing of the current frame of this feed began; 0 without one."""
        with self._lock:
            job = self._slot.job
            return self._schedule.clock() - job.begun_s if job else 0.0


def _outcome(error: Exception) -> Outcome:
    return Outcome.REJECTED if isinstance(error, ImageError) else Outcome.FAILED
