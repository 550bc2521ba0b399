"""The inference threads of a session, which serve the newest frames of its cameras in turn."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import attrgetter
from queue import SimpleQueue
from typing import Any, Protocol

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_statistics import FrameCounter, Outcome

Send = Callable[[], object]
"""Sends one finished message."""


class Pipeline(Protocol):
    """Processes the frames of one camera, one at a time, in the inference threads.

    Networks are compared by identity; one thread at a time uses each of them. Pipelines with the same model
    have the same ones.
    """

    @property
    def whole(self) -> Any:
        """The network of a frame while no other one is in progress; it may use all processors."""

    @property
    def parallel(self) -> Sequence[Any]:
        """Networks for frames of different cameras at the same time, which share the processors.

        Empty: one frame at a time.
        """

    def detect(self, frame: Any, network: Any) -> Any:
        """The result for `frame` from one of the networks. Raises ImageError when the frame is unreadable."""

    def messages(self, result: Any) -> Iterator[Send]:
        """Compute what to publish of the result of `detect`, one message after the other.

        Each item sends one message and computes nothing. The frame may be abandoned between any two items;
        then the rest is never asked for.
        """


class CameraQueue:
    """The newest frame of one camera, its rate limit and counts; only `InferenceThreads` uses it.

    An inference thread calls `report(outcome, error)` after it has counted a frame in `counter`, except for a
    frame that was abandoned.
    """

    def __init__(self, counter: FrameCounter, report: Callable[[Outcome, Exception | None], None]) -> None:
        self.counter = counter
        self.report = report
        self.pipeline: Pipeline | None = None
        """None: stopped."""
        self.frame: Any = None
        """The frame that waits."""
        self.task: FrameTask | None = None
        """The frame in progress; the next one waits for its end."""
        self.last_turn = 0
        """Number of its latest turn; the turns of all cameras are numbered together."""
        self._max_rate_hz = self._due_s = 0.0

    def start(self, pipeline: Pipeline, max_rate_hz: float) -> None:
        """Accept frames, for `pipeline`, from now on; an unchanged rate limit keeps its schedule."""
        self.pipeline = pipeline
        if max_rate_hz != self._max_rate_hz:
            self._max_rate_hz, self._due_s = max_rate_hz, 0.0

    def stop(self) -> None:
        """Flush the waiting frame and accept no more."""
        self.pipeline = None
        if self.frame is not None:
            self.frame = None
            self.counter.finish(Outcome.FLUSHED)

    def receive(self, frame: Any, now_s: float) -> None:
        """Count `frame`, received at `now_s` (monotonic seconds), and let it wait unless it is dropped.

        `max_rate_hz` is a schedule, not a minimum gap: 20 Hz out of a 30 Hz stream gives 20, not 15.
        """
        self.counter.receive()
        if self.pipeline is None:
            self.counter.finish(Outcome.INACTIVE)
        elif now_s < self._due_s:
            self.counter.finish(Outcome.SKIPPED)
        else:
            if self._max_rate_hz:
                self._due_s = max(self._due_s + 1 / self._max_rate_hz, now_s)
            if self.frame is not None:
                self.counter.finish(Outcome.STALE)
            self.frame = frame


@dataclass(eq=False, slots=True)
class FrameTask:
    """A frame of `queue` that a thread has processed in `network` since `begun_s` (monotonic seconds)."""

    queue: CameraQueue
    pipeline: Pipeline
    frame: Any
    network: Any
    begun_s: float
    has_sent: bool = False
    """Whether its first message, the detections, was sent or is being sent."""
    awaited_s: float | None = None
    """When the first wait for its end began, None before that."""


class InferenceThreads:
    """Run pipelines on the newest frames of cameras: frames of one camera one after the other, of different
    cameras at the same time if their networks allow it. The camera served longest ago is next.

    Torch keeps a thread pool and warm caches per calling thread, so the idle thread that worked last is next.

    A frame that hangs ends all: `close` abandons it with its thread. Such a frame counts as failed unless its
    detections were sent, what it has not sent is dropped, and its thread ends when it does.

    `clock` returns monotonic seconds.
    """

    def __init__(self, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.RLock()
        self._ended = threading.Condition(self._lock)
        self._queues: list[CameraQueue] = []
        self._tasks: list[FrameTask] = []
        """In progress, of different cameras, each with a network of its own."""
        self._abandoned: list[FrameTask] = []
        self._turns = 0
        self._pauses = 0
        self._is_closed = False
        self._threads: dict[SimpleQueue[FrameTask | None], threading.Thread] = {}
        self._idle: list[SimpleQueue[FrameTask | None]] = []

    def start(self, queue: CameraQueue, pipeline: Pipeline, *, max_rate_hz: float = 0.0) -> None:
        """Serve `queue` with `pipeline` and `max_rate_hz` from its next frame on; 0: no limit.

        Raises RuntimeError after `close`, or if the system refuses a thread.
        """
        with self._lock:
            if self._is_closed:
                raise RuntimeError("the inference threads are closed; create others")
            while len(self._threads) < max(1, len(pipeline.parallel)):
                self._add_thread()
            if queue not in self._queues:
                self._queues.append(queue)
            queue.start(pipeline, max_rate_hz)
            self._begin_tasks()  # a frame that waits for another network may begin

    def offer(self, queue: CameraQueue, frame: Any) -> None:
        """Submit a frame of `queue`; it replaces a waiting one, unless the rate limit drops it."""
        with self._lock:
            queue.receive(frame, self._clock())
            self._begin_tasks()

    def busy_s(self, queue: CameraQueue) -> float:
        """Seconds since processing of the current frame of `queue` began; 0 without one."""
        with self._lock:
            return self._clock() - queue.task.begun_s if queue.task else 0.0

    @contextmanager
    def paused(self) -> Iterator[None]:
        """In the block no frame begins; those in progress go on."""
        with self._lock:
            self._pauses += 1
        try:
            yield
        finally:
            with self._lock:
                self._pauses -= 1
                self._begin_tasks()

    @property
    def hanging(self) -> int:
        """Number of abandoned threads that still process their frame."""
        with self._lock:
            return len(self._abandoned)

    def rest(self, timeout_s: float) -> bool:
        """Wait for the end of the frames in progress; False if one goes on or was abandoned.

        The time of a frame begins with the first wait for it: a second wait continues it.
        """
        with self._lock:
            now_s, tasks, left_s = self._clock(), [*self._tasks], 0.0
            for task in tasks:
                task.awaited_s = now_s if task.awaited_s is None else task.awaited_s
                left_s = max(left_s, timeout_s - (now_s - task.awaited_s))
            have_ended = self._ended.wait_for(lambda: not any(task in self._tasks for task in tasks), left_s)
            return have_ended and not self._abandoned

    def close(self, timeout_s: float) -> bool:
        """Flush waiting frames, wait for those in progress, end the threads; False if frames hang.

        These are abandoned.
        """
        with self._lock:
            self._is_closed = True
            for queue in self._queues:
                queue.stop()
            has_rested = self.rest(timeout_s)
            for task in [*self._tasks]:
                self._abandoned.append(task)
                self._count(task, Outcome.DETECTED if task.has_sent else Outcome.FAILED)
            for inbox in self._threads:
                inbox.put(None)
        end_s = time.monotonic() + (timeout_s if has_rested else 0.0)
        for thread in self._threads.values():
            thread.join(max(0.0, end_s - time.monotonic()))
        return has_rested

    def _add_thread(self) -> None:
        inbox: SimpleQueue[FrameTask | None] = SimpleQueue()
        thread = threading.Thread(target=self._run, args=(inbox,), name="inference", daemon=True)
        thread.start()
        self._threads[inbox] = thread
        self._idle.append(inbox)

    def _begin_tasks(self) -> None:
        """Begin every frame that may begin now; hold the lock, whenever something has changed."""
        while self._idle and (task := self._next_task()) is not None:
            self._idle.pop().put(task)

    def _next_task(self) -> FrameTask | None:
        """The next frame, begun: of the camera served longest ago that has a free network."""
        if self._pauses or any(task.network is task.pipeline.whole for task in self._tasks):
            return None  # a frame in `whole` may use all processors
        ready = [queue for queue in self._queues if queue.frame is not None and queue.task is None]
        for queue in sorted(ready, key=attrgetter("last_turn")):
            assert queue.pipeline is not None, "a stopped queue has no frame"
            network = self._free_network(queue.pipeline, is_only_one=len(ready) == 1)
            if network is not None:
                self._turns += 1
                task = FrameTask(queue, queue.pipeline, queue.frame, network, self._clock())
                queue.task, queue.frame, queue.last_turn = task, None, self._turns
                self._tasks.append(task)
                return task
        return None

    def _free_network(self, pipeline: Pipeline, *, is_only_one: bool) -> Any:
        """The network for the next frame, None if it has to wait.

        A frame runs in `whole` if it is the only one in progress and waiting, beside others in `parallel`.
        """
        if not self._tasks:
            return pipeline.parallel[0] if pipeline.parallel and not is_only_one else pipeline.whole
        used = [task.network for task in self._tasks]
        return next((each for each in pipeline.parallel if not any(each is other for other in used)), None)

    def _run(self, inbox: SimpleQueue[FrameTask | None]) -> None:
        while (task := inbox.get()) is not None:
            self._serve(task)
            del task  # an idle thread holds no frame
            with self._lock:
                self._idle.append(inbox)
                self._begin_tasks()

    def _serve(self, task: FrameTask) -> None:
        try:
            self._process(task)
        except Exception as error:  # noqa: BLE001 - counted and reported; the next frame is processed
            self._end(task, Outcome.REJECTED if isinstance(error, ImageError) else Outcome.FAILED, error)
        else:
            self._end(task, Outcome.DETECTED)

    def _process(self, task: FrameTask) -> None:
        """Detect in the frame, compute and send its messages, until it is abandoned."""
        result = task.pipeline.detect(task.frame, task.network)
        if task in self._abandoned:
            return
        for send in task.pipeline.messages(result):
            with self._lock:
                if task in self._abandoned:
                    return
                task.has_sent = True
            send()

    def _end(self, task: FrameTask, outcome: Outcome, error: Exception | None = None) -> None:
        """Count and report the frame, unless that was abandoned."""
        with self._lock:
            if task in self._abandoned:
                self._abandoned.remove(task)
                return
            self._count(task, outcome)
        task.queue.report(outcome, error)

    def _count(self, task: FrameTask, outcome: Outcome) -> None:
        task.queue.counter.finish(outcome)
        task.queue.task = None
        self._tasks.remove(task)
        self._ended.notify_all()
