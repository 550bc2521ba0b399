"""A camera of numbers, with gates that hold its frames while they are detected, published or drawn."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence

from support.gate import PATIENCE_S, Gate
from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_statistics import FrameCounter, Outcome
from yolov5_lifecycle.streaming.inference_threads import CameraQueue, InferenceThreads, Pipeline, Send


def when_awaited(inference: InferenceThreads, act: Callable[[], object]) -> None:
    """Call `act` whenever somebody begins to wait for the frame in progress, which cannot end before that."""
    ended = inference._ended
    wait_for = ended.wait_for

    def acted(predicate: Callable[[], bool], timeout: float | None = None) -> bool:
        act()
        return wait_for(predicate, timeout)

    ended.wait_for = acted  # type: ignore[assignment,method-assign]


class ScriptedCamera:
    """A queue and its pipeline: a negative number is no image, zero an error of inference.

    `used` are the networks of its frames.
    """

    def __init__(
        self, inference: InferenceThreads, whole: object = "whole", parallel: Sequence[object] = ()
    ) -> None:
        self.inference = inference
        self.whole = whole
        self.parallel = parallel
        self.used: list[object] = []
        self.published: list[int] = []
        self.failures: list[tuple[Outcome, str]] = []
        self.threads: list[threading.Thread] = []
        self.gate, self.publishing, self.drawing = (Gate(is_open=True) for _ in range(3))
        self.drawn: list[int] = []
        self.ended = threading.Semaphore(0)
        self.queue = CameraQueue(FrameCounter(), self._report)

    def detect(self, number: int, network: object) -> int:
        self.used.append(network)
        self.threads.append(threading.current_thread())
        self.gate.passed()
        if number < 0:
            raise ImageError(f"{number} is no image")
        if number == 0:
            raise RuntimeError("zero")
        return number

    def messages(self, result: int) -> Iterator[Send]:
        self.threads.append(threading.current_thread())
        yield lambda: self._publish(result)
        self.drawing.passed()
        yield lambda: self.drawn.append(result)

    def _publish(self, result: int) -> None:
        self.publishing.passed()
        self.published.append(result)

    def start(self, pipeline: Pipeline | None = None, *, max_rate_hz: float = 0.0) -> None:
        self.inference.start(self.queue, pipeline or self, max_rate_hz=max_rate_hz)

    def offer(self, *numbers: int) -> None:
        for number in numbers:
            self.inference.offer(self.queue, number)

    def feed(self, number: int) -> None:
        """Offer one frame and wait until it ended."""
        self.offer(number)
        self.wait()

    def wait(self) -> None:
        """Wait until one more frame ended."""
        assert self.ended.acquire(timeout=PATIENCE_S)

    def hold(self, number: int) -> None:
        """Offer one frame and return while a thread is inside it."""
        self.gate.close()
        self.offer(number)
        self.gate.wait_until_reached()

    def open(self) -> None:
        """Let frames go on, now and in all frames to come."""
        for gate in (self.gate, self.publishing, self.drawing):
            gate.open()

    def balance(self) -> dict[str, int]:
        return self.queue.counter.balance()

    def counts(self) -> dict[Outcome, int]:
        """Outcomes that occurred."""
        balance = self.balance()
        return {outcome: balance[outcome.value] for outcome in Outcome if balance[outcome.value]}

    def _report(self, outcome: Outcome, error: Exception | None) -> None:
        if error is not None:
            self.failures.append((outcome, str(error)))
        self.ended.release()
