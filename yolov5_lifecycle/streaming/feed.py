"""Feeds: the newest frame of each camera, within its rate limit, and whose frame is next."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from yolov5_lifecycle.streaming.frame_statistics import FrameBalance, FrameCounter, Outcome

Frame = TypeVar("Frame")
Result = TypeVar("Result")
AnyFrame = TypeVar("AnyFrame", contravariant=True)


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
        """The job in progress, if it has a frame of this camera."""
        self.last_turn = 0
        """Number of its last turn among those of all slots."""
        self._rate_limit = RateLimit(0.0)

    def start(self, pipeline: Pipeline[Frame, Result], max_rate_hz: float) -> None:
        """Accept frames, for `pipeline`, from now on; the same rate goes on."""
        self.pipeline = pipeline
        if max_rate_hz != self._rate_limit.max_rate_hz:
            self._rate_limit = RateLimit(max_rate_hz)

    def stop(self) -> None:
        """Flush the frame that waits, and accept none."""
        self.pipeline = None
        self._rate_limit = RateLimit(0.0)
        if self.frame is not None:
            self.frame = None
            self.counter.finish(Outcome.FLUSHED)

    def receive(self, frame: Frame, now_s: float) -> bool:
        """Count `frame`, received at `now_s`; whether it waits now."""
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


@dataclass(eq=False)
class Turn(Generic[Frame, Result]):
    """The frame of `slot` that is processed, and the pipeline for it."""

    slot: Slot[Frame, Result]
    pipeline: Pipeline[Frame, Result]
    frame: Frame


@dataclass(eq=False)
class Job(Generic[Frame, Result]):
    """What the thread works on since `begun_s` (monotonic seconds)."""

    turns: Sequence[Turn[Frame, Result]]
    begun_s: float
    is_publishing: bool = False
    is_abandoned: bool = False


class Schedule(Generic[Frame, Result]):
    """The slots of one worker and the job in progress.

    Of the slots with a waiting frame, the one served longest ago is next. Whoever calls a method or uses a
    slot holds `changed`. `replace_thread()` is called with it when a job hangs.
    """

    def __init__(self, *, clock: Callable[[], float], replace_thread: Callable[[], None]) -> None:
        self.changed = threading.Condition()
        self.clock = clock
        self.job: Job[Frame, Result] | None = None
        self.slots: set[Slot[Frame, Result]] = set()
        self._waiting: dict[Slot[Frame, Result], None] = {}
        self._replace_thread = replace_thread
        self._turns = 0

    @property
    def has_waiting(self) -> bool:
        return bool(self._waiting)

    def offer(self, slot: Slot[Frame, Result], frame: Frame) -> None:
        """Let `frame` wait in `slot`, unless it is stopped or its rate limit drops the frame."""
        if slot.receive(frame, self.clock()):
            self._waiting[slot] = None
            self.changed.notify_all()

    def stop(self, slots: Sequence[Slot[Frame, Result]]) -> None:
        """Stop `slots` and flush their waiting frames."""
        for slot in slots:
            slot.stop()
            self._waiting.pop(slot, None)

    def begin(self) -> Job[Frame, Result]:
        """Begin the job that is next; there must be a waiting frame."""
        slot = min(self._waiting, key=lambda slot: slot.last_turn)
        job = self.job = Job([self._take(slot)], self.clock())
        for turn in job.turns:
            turn.slot.job = job
        return job

    def finish(self, job: Job[Frame, Result], outcomes: Sequence[Outcome]) -> None:
        """Count the frames of `job`, which is over, with their `outcomes`."""
        for turn, outcome in zip(job.turns, outcomes, strict=True):
            turn.slot.counter.finish(outcome)
            turn.slot.job = None
        self.job = None
        self.changed.notify_all()

    def wait(self, job: Job[Frame, Result] | None, timeout_s: float | None) -> bool:
        """Wait for the end of `job`, if any; False on timeout or if it was abandoned."""
        if job is None:
            return True
        return self.changed.wait_for(lambda: self.job is not job, timeout_s) and not job.is_abandoned

    def wait_or_abandon(self, job: Job[Frame, Result] | None, timeout_s: float) -> bool:
        """Wait for the end of `job`, if any; False if it hung and was abandoned."""
        if self.wait(job, timeout_s):
            return True
        if job is not None and job is self.job:
            if job.is_publishing:
                # A publish in progress cannot be cancelled; publishing never takes long.
                return self.wait(job, None)
            job.is_abandoned = True
            self.finish(job, [Outcome.FAILED] * len(job.turns))
            self._replace_thread()
        return False

    def _take(self, slot: Slot[Frame, Result]) -> Turn[Frame, Result]:
        del self._waiting[slot]
        self._turns += 1
        slot.last_turn = self._turns
        pipeline, frame, slot.frame = slot.pipeline, slot.frame, None
        assert pipeline is not None, "a stopped slot does not wait"
        assert frame is not None, "a slot without a frame does not wait"
        return Turn(slot, pipeline, frame)


class Feed(Generic[Frame, Result]):
    """The frames of one camera; made by `Worker.feed`."""

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
                raise RuntimeError("the feed is closed; make another one with Worker.feed()")
            self._slot.start(pipeline, max_rate_hz)

    def offer(self, frame: Frame) -> None:
        """Submit a frame; it replaces a waiting one, unless the rate limit drops it."""
        with self._changed:
            self._schedule.offer(self._slot, frame)

    def stop(self, timeout_s: float) -> bool:
        """Stop after the current frame of this feed and flush the waiting one; True when it ended in time.

        False: the thread hung. It was abandoned and a new one serves the other feeds. The frames of a batch
        hang together.
        """
        with self._changed:
            self._schedule.stop([self._slot])
            return self._schedule.wait_or_abandon(self._slot.job, timeout_s)

    def close(self) -> None:
        """Let the worker forget this feed; call after `stop`. Frames that still come are INACTIVE."""
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
