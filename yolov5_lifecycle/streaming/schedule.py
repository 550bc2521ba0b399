"""The newest frame of each camera, its rate limit and counts, and the order in which cameras are served."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Generic

from yolov5_lifecycle.streaming.frame_statistics import FrameCounter, Outcome
from yolov5_lifecycle.streaming.pipeline import Frame, Networks, Pipeline, Result


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


class Slot(Generic[Frame, Result]):
    """The newest frame of one camera with its rate limit and counts; not thread-safe, see `Schedule`."""

    def __init__(
        self, *, on_failure: Callable[[Outcome, Exception], None], on_success: Callable[[], None]
    ) -> None:
        self.on_failure = on_failure
        self.on_success = on_success
        self.counter = FrameCounter()
        self.pipeline: Pipeline[Frame, Result] | None = None
        """None: stopped."""
        self.frame: Frame | None = None
        """The frame that waits."""
        self.job: Job[Frame, Result] | None = None
        """The job in progress, if it has a frame of this camera; the next frame waits for its end."""
        self.last_turn = 0
        """Number of its latest turn; the turns of all slots are numbered together."""
        self._rate_limit = RateLimit(0.0)

    def start(self, pipeline: Pipeline[Frame, Result], max_rate_hz: float) -> None:
        """Accept frames, for `pipeline`, from now on; an unchanged rate limit keeps its schedule."""
        self.pipeline = pipeline
        if max_rate_hz != self._rate_limit.max_rate_hz:
            self._rate_limit = RateLimit(max_rate_hz)

    def stop(self) -> None:
        """Flush the waiting frame and accept no more."""
        self.pipeline = None
        self._rate_limit = RateLimit(0.0)
        if self.frame is not None:
            self.frame = None
            self.counter.finish(Outcome.FLUSHED)

    def receive(self, frame: Frame, now_s: float) -> bool:
        """Count `frame`, received at `now_s`; return whether it waits now."""
        self.counter.receive()
        if self.pipeline is None:
            self.counter.finish(Outcome.INACTIVE)
            return False
        if not self._rate_limit.admits(now_s):
            self.counter.finish(Outcome.SKIPPED)
            return False
        if self.frame is not None:
            self.counter.finish(Outcome.STALE)
        self.frame = frame
        return True

    @property
    def jobs(self) -> Sequence[Job[Frame, Result]]:
        """The job in progress, if any."""
        return [self.job] if self.job else []

    def begin(self, network: Any, begun_s: float, number: int) -> Job[Frame, Result]:
        """The job of the waiting frame in `network`, as turn `number`, see `last_turn`; not while stopped."""
        assert self.pipeline is not None, "a stopped slot has no turn"
        assert self.frame is not None, "a slot without a frame has no turn"
        self.job = Job(self, self.pipeline, self.pipeline.networks, self.frame, network, begun_s)
        self.frame = None
        self.last_turn = number
        return self.job


@dataclass(eq=False, slots=True)
class Job(Generic[Frame, Result]):
    """A frame of `slot` that a thread has processed in `network` since `begun_s` (monotonic seconds)."""

    slot: Slot[Frame, Result]
    pipeline: Pipeline[Frame, Result]
    networks: Networks
    frame: Frame
    network: Any
    begun_s: float
    outcome: Outcome = Outcome.DETECTED
    error: Exception | None = None
    has_sent: bool = False
    """Whether its first message, the detections, was sent or is being sent."""
    awaited_s: float | None = None
    """When the first wait for its end began, None before that."""
    is_abandoned: bool = False

    @property
    def is_alone(self) -> bool:
        """Whether no other job may begin, because this one may use all processors."""
        return self.network is self.networks.whole

    def fail(self, outcome: Outcome, error: Exception) -> None:
        self.outcome = outcome
        self.error = error

    def abandon(self) -> None:
        """Fail the frame unless its detections were sent; then it counts as detected."""
        self.is_abandoned = True
        if self.error is None and not self.has_sent:
            self.outcome = Outcome.FAILED

    def report(self) -> None:
        """Call `on_success` or `on_failure`; without the lock, after the frame was counted."""
        if self.error is None:
            self.slot.on_success()
        else:
            self.slot.on_failure(self.outcome, self.error)


class Schedule(Generic[Frame, Result]):
    """The slots of one worker, the jobs in progress, and abandoned ones.

    Of the slots with a waiting frame, the one served longest ago is next. Whoever calls a method or uses a
    slot holds `lock`. `on_abandoned(job)` is called with it when a job hangs.
    """

    def __init__(
        self, *, clock: Callable[[], float], on_abandoned: Callable[[Job[Frame, Result]], None]
    ) -> None:
        self.lock = threading.RLock()
        self.clock = clock
        self.jobs: list[Job[Frame, Result]] = []
        """In progress, of different cameras, each with a network of its own."""
        self.slots: set[Slot[Frame, Result]] = set()
        self.waiting: dict[Slot[Frame, Result], None] = {}
        self.pauses = 0
        """While above 0, no job begins."""
        self._on_abandoned = on_abandoned
        self._ended = threading.Condition(self.lock)
        self._turns = 0

    def offer(self, slot: Slot[Frame, Result], frame: Frame) -> None:
        """Let `frame` wait in `slot`, unless it is stopped or its rate limit drops the frame."""
        if slot.receive(frame, self.clock()):
            self.waiting[slot] = None

    def stop(self, slots: Iterable[Slot[Frame, Result]]) -> None:
        """Stop `slots` and flush their waiting frames."""
        for slot in slots:
            slot.stop()
            self.waiting.pop(slot, None)

    def begin(self) -> Job[Frame, Result] | None:
        """Start the next job, if one may begin: of the camera served longest ago that has a free network."""
        if self.pauses or any(job.is_alone for job in self.jobs):
            return None
        ready = sorted((slot for slot in self.waiting if slot.job is None), key=attrgetter("last_turn"))
        for slot in ready:
            assert slot.pipeline is not None, "a stopped slot waits for nothing"
            network = self._free_network(
                slot.pipeline.networks, is_only_one=len(ready) == 1 and not self.jobs
            )
            if network is not None:
                return self._begun(slot, network)
        return None

    def _free_network(self, networks: Networks, *, is_only_one: bool) -> Any:
        """The network for the next frame, None if it has to wait.

        A frame runs in `whole` if it is the only one in progress and waiting, beside others in `parallel`.
        """
        if self.jobs:
            candidates = [*networks.parallel]
        elif is_only_one:
            candidates = [networks.whole, *networks.parallel]
        else:
            candidates = [*networks.parallel, networks.whole]
        used = [job.network for job in self.jobs]
        return next((each for each in candidates if not any(each is other for other in used)), None)

    def _begun(self, slot: Slot[Frame, Result], network: Any) -> Job[Frame, Result]:
        self._turns += 1
        job = slot.begin(network, self.clock(), self._turns)
        self.jobs.append(job)
        del self.waiting[slot]
        return job

    def end(self, job: Job[Frame, Result]) -> None:
        """Finish `job` at the end of its thread's work, unless it was abandoned."""
        if not job.is_abandoned:
            self._finish(job)

    def _finish(self, job: Job[Frame, Result]) -> None:
        """Count the frame of `job` with its outcome."""
        job.slot.counter.finish(job.outcome)
        job.slot.job = None
        self.jobs.remove(job)
        self._ended.notify_all()

    def wait(self, jobs: Sequence[Job[Frame, Result]], timeout_s: float) -> bool:
        """Wait for the end of `jobs`; False if one was abandoned or has not ended in time.

        The time of a job begins with the first wait for it: a second wait continues it.
        """
        now_s = self.clock()
        for job in jobs:
            job.awaited_s = now_s if job.awaited_s is None else job.awaited_s
        have_ended = [self._has_ended(job, timeout_s) for job in jobs]
        return all(have_ended)

    def wait_or_abandon(self, jobs: Sequence[Job[Frame, Result]], timeout_s: float) -> bool:
        """Wait for the end of `jobs`; False if one hung and was abandoned."""
        if self.wait(jobs, timeout_s):
            return True
        for job in jobs:
            if job in self.jobs:
                job.abandon()
                self._finish(job)
                self._on_abandoned(job)
        return False

    def _has_ended(self, job: Job[Frame, Result], timeout_s: float) -> bool:
        awaited_s = self.clock() - (job.awaited_s or 0.0)
        rest_s = max(0.0, timeout_s - awaited_s)
        return self._ended.wait_for(lambda: job not in self.jobs, rest_s) and not job.is_abandoned
