"""The newest frame of each camera, its rate limit and counts, and the order in which cameras are served."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Generic

from yolov5_lifecycle.streaming.frame_statistics import FrameBalance, FrameCounter, Outcome
from yolov5_lifecycle.streaming.pipeline import Batch, Frame, Pipeline, Result


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

    def turn(self) -> Turn[Frame, Result]:
        """The waiting frame with the current pipeline; for a slot that has a frame and is not stopped."""
        assert self.pipeline is not None, "a stopped slot has no turn"
        assert self.frame is not None, "a slot without a frame has no turn"
        return Turn(self, self.pipeline, self.frame, self.pipeline.network)

    def begin(self, job: Job[Frame, Result], number: int) -> None:
        """Hand the waiting frame over to `job`, as turn `number`; see `last_turn`."""
        self.frame = None
        self.job = job
        self.last_turn = number


@dataclass(eq=False, slots=True)
class Turn(Generic[Frame, Result]):
    """Processing of one frame of `slot`: its pipeline and its outcome."""

    slot: Slot[Frame, Result]
    pipeline: Pipeline[Frame, Result]
    frame: Frame
    network: object
    outcome: Outcome = Outcome.DETECTED
    error: Exception | None = None
    has_sent: bool = False
    """Whether its first message, the detections, was sent or is being sent."""

    def fail(self, outcome: Outcome, error: Exception) -> None:
        self.outcome = outcome
        self.error = error

    def report(self) -> None:
        """Call `on_success` or `on_failure`; without the lock, after the frame was counted."""
        if self.error is None:
            self.slot.on_success()
        else:
            self.slot.on_failure(self.outcome, self.error)


@dataclass(eq=False, slots=True)
class Job(Generic[Frame, Result]):
    """One frame or batch that the thread has processed since `begun_s` (monotonic seconds)."""

    turns: Sequence[Turn[Frame, Result]]
    begun_s: float
    awaited_s: float | None = None
    """When the first wait for its end began, None before that."""
    is_abandoned: bool = False

    def abandon(self) -> None:
        """Fail the frames whose detections were not sent; the others count as detected."""
        self.is_abandoned = True
        for turn in self.turns:
            if turn.error is None and not turn.has_sent:
                turn.outcome = Outcome.FAILED


class Schedule(Generic[Frame, Result]):
    """The slots of one worker, the job in progress, and abandoned ones.

    Of the slots with a waiting frame, the one served longest ago is next. Whoever calls a method or uses a
    slot holds `changed`. `replace_thread()` is called with it when a job hangs.
    """

    def __init__(self, *, clock: Callable[[], float], replace_thread: Callable[[], None]) -> None:
        self.changed = threading.Condition()
        self.clock = clock
        self.job: Job[Frame, Result] | None = None
        self.slots: set[Slot[Frame, Result]] = set()
        self.waiting: dict[Slot[Frame, Result], None] = {}
        self.pauses = 0
        """While above 0, no job begins."""
        self._abandoned: list[Job[Frame, Result]] = []
        """Abandoned jobs whose threads have not ended: their networks belong to them."""
        self._replace_thread = replace_thread
        self._turns = 0

    def offer(self, slot: Slot[Frame, Result], frame: Frame) -> None:
        """Let `frame` wait in `slot`, unless it is stopped or its rate limit drops the frame."""
        if slot.receive(frame, self.clock()):
            self.waiting[slot] = None
            self.changed.notify_all()

    def stop(self, slots: Sequence[Slot[Frame, Result]]) -> None:
        """Stop `slots` and flush their waiting frames."""
        for slot in slots:
            slot.stop()
            self.waiting.pop(slot, None)

    def ready(self) -> Sequence[Slot[Frame, Result]]:
        """The slots whose waiting frame may begin: those whose network no abandoned job keeps."""
        return [] if self.pauses else [each for each in self.waiting if not self.keeps(each.turn().network)]

    def begin(self, batch: Batch[Frame, Result] | None = None) -> Job[Frame, Result]:
        """Start the next job; a slot must be `ready`.

        With `batch`, waiting frames with the same key join the next one, those served longest ago first.
        """
        slots = self._next_slots(self.ready(), batch)
        job = self.job = Job([slot.turn() for slot in slots], self.clock())
        for turn in job.turns:
            self._turns += 1
            turn.slot.begin(job, self._turns)
            del self.waiting[turn.slot]
        return job

    def end(self, job: Job[Frame, Result]) -> None:
        """Finish `job` at the end of its thread's work; of an abandoned one, only its network is free now."""
        if not job.is_abandoned:
            self._finish(job)
            return
        self._abandoned.remove(job)
        self.changed.notify_all()

    def _finish(self, job: Job[Frame, Result]) -> None:
        """Count the frames of `job` with their outcomes."""
        for turn in job.turns:
            turn.slot.counter.finish(turn.outcome)
            turn.slot.job = None
        self.job = None
        self.changed.notify_all()

    def wait(self, job: Job[Frame, Result] | None, timeout_s: float) -> bool:
        """Wait for the end of `job`, if any; False if it was abandoned or has not ended in time.

        The time begins with the first wait for this job: a second wait continues it.
        """
        if job is None:
            return True
        now_s = self.clock()
        job.awaited_s = now_s if job.awaited_s is None else job.awaited_s
        rest_s = max(0.0, timeout_s - (now_s - job.awaited_s))
        return self.changed.wait_for(lambda: self.job is not job, rest_s) and not job.is_abandoned

    def wait_or_abandon(self, job: Job[Frame, Result] | None, timeout_s: float) -> bool:
        """Wait for the end of `job`, if any; False if it hung and was abandoned."""
        if self.wait(job, timeout_s):
            return True
        if job is not None and job is self.job:
            job.abandon()
            self._abandoned.append(job)
            self._finish(job)
            self._replace_thread()
        return False

    def keeps(self, network: object) -> bool:
        """Whether an abandoned job keeps `network`."""
        return any(turn.network is network for job in self._abandoned for turn in job.turns)

    def _next_slots(
        self, ready: Sequence[Slot[Frame, Result]], batch: Batch[Frame, Result] | None
    ) -> Sequence[Slot[Frame, Result]]:
        if batch is None or len(ready) == 1:
            return [min(ready, key=attrgetter("last_turn"))]
        first, *others = sorted(ready, key=attrgetter("last_turn"))
        slots = [first]
        if (key := _key(batch, first)) is not None:
            for slot in others:
                if len(slots) >= batch.max_size:
                    break
                if _key(batch, slot) == key:
                    slots.append(slot)
        return slots


def _key(batch: Batch[Frame, Result], slot: Slot[Frame, Result]) -> Hashable | None:
    turn = slot.turn()
    try:
        return batch.key(turn.pipeline, turn.frame)
    except Exception:  # noqa: BLE001 - `detect` reports the problem of the frame
        return None


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

        False: the thread hung and was abandoned; a new one serves the other feeds once they have another
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
