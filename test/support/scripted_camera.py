"""A camera of numbers on a worker, with a gate that holds the worker while it detects or publishes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.streaming.pipeline import Networks, Send
from yolov5_lifecycle.streaming.worker import Worker

PATIENCE_S = 60.0


def when_awaited(worker: Worker[int, int], act: Callable[[], object]) -> None:
    """Call `act` whenever somebody begins to wait for the job in progress, which cannot end before that."""
    ended = worker._schedule._ended
    wait_for = ended.wait_for

    def acted(predicate: Callable[[], bool], timeout: float | None = None) -> bool:
        act()
        return wait_for(predicate, timeout)

    ended.wait_for = acted  # type: ignore[assignment,method-assign]


class ScriptedCamera:
    """A feed and its pipeline: a negative number is no image, zero an error of inference.

    It has a network of its own unless `networks` are given; `used` are the networks of its frames.
    """

    def __init__(self, worker: Worker[int, int], networks: Networks | None = None) -> None:
        self.networks = networks or Networks(self)
        self.used: list[object] = []
        self.published: list[int] = []
        self.failures: list[tuple[Outcome, str]] = []
        self.threads: list[int] = []
        self.gate = threading.Event()
        self.gate.set()
        self.entered = threading.Event()
        self.publish_gate = threading.Event()
        self.publish_gate.set()
        self.publishing = threading.Event()
        self.draw_gate = threading.Event()
        self.draw_gate.set()
        self.drawing = threading.Event()
        self.drawn: list[int] = []
        self.ended = threading.Semaphore(0)
        self.frames = worker.feed(on_failure=self._fail, on_success=self.ended.release)

    def detect(self, number: int, network: object) -> int:
        self.used.append(network)
        self.threads.append(threading.get_ident())
        self.entered.set()
        assert self.gate.wait(PATIENCE_S)
        if number < 0:
            raise ImageError(f"{number} is no image")
        if number == 0:
            raise RuntimeError("zero")
        return number

    def messages(self, result: int) -> Iterator[Send]:
        self.threads.append(threading.get_ident())
        yield lambda: self._publish(result)
        self.drawing.set()
        assert self.draw_gate.wait(PATIENCE_S)
        yield lambda: self.drawn.append(result)

    def _publish(self, result: int) -> None:
        self.publishing.set()
        assert self.publish_gate.wait(PATIENCE_S)
        self.published.append(result)

    def offer(self, number: int) -> None:
        self.frames.offer(number)

    def feed(self, number: int) -> None:
        """Offer one frame and wait until it ended."""
        self.offer(number)
        self.wait()

    def wait(self) -> None:
        """Wait until one more frame ended."""
        assert self.ended.acquire(timeout=PATIENCE_S)

    def hold(self, number: int) -> None:
        """Offer one frame and return while the worker is inside it."""
        self.gate.clear()
        self.entered.clear()
        self.offer(number)
        assert self.entered.wait(PATIENCE_S)

    def open(self) -> None:
        """Let the worker go on, now and in all frames to come."""
        self.gate.set()
        self.publish_gate.set()
        self.draw_gate.set()

    def count(self, outcome: Outcome) -> int:
        return self.frames.balance()[outcome]

    def counts(self) -> dict[Outcome, int]:
        """Outcomes that occurred."""
        return {outcome: count for outcome, count in self.frames.balance().outcomes.items() if count}

    def _fail(self, outcome: Outcome, error: Exception) -> None:
        self.failures.append((outcome, str(error)))
        self.ended.release()
