"""The inference worker: newest frame first, every frame counted once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_balance import Outcome
from yolov5_lifecycle.streaming.worker import Worker

PATIENCE_S = 10.0


class Line:
    """A worker on a line of numbers, with a gate that holds it while it works."""

    def __init__(self) -> None:
        self.delivered: list[int] = []
        self.failures: list[tuple[Outcome, str]] = []
        self.threads: set[int] = set()
        self.gate = threading.Event()
        self.gate.set()
        self.entered = threading.Event()
        self.ended = threading.Semaphore(0)
        self.worker: Worker[int] = Worker(on_failure=self._fail, on_success=self.ended.release)

    def process(self, number: int) -> Callable[[], None]:
        self.threads.add(threading.get_ident())
        self.entered.set()
        assert self.gate.wait(PATIENCE_S)
        if number < 0:
            raise ImageError(f"{number} is no image")
        if number == 0:
            raise RuntimeError("zero")
        return lambda: self.delivered.append(number)

    def feed(self, number: int) -> None:
        """Offer one frame and wait until it ended."""
        self.worker.offer(number)
        assert self.ended.acquire(timeout=PATIENCE_S)

    def hold(self, number: int) -> None:
        """Offer one frame and return while the worker is inside it."""
        self.gate.clear()
        self.entered.clear()
        self.worker.offer(number)
        assert self.entered.wait(PATIENCE_S)

    def count(self, outcome: Outcome) -> int:
        return self.worker.balance()[outcome]

    def _fail(self, outcome: Outcome, error: Exception) -> None:
        self.failures.append((outcome, str(error)))
        self.ended.release()


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.gate.set()
    line.worker.close(PATIENCE_S)
    balance = line.worker.balance()
    assert balance.received == sum(balance.outcomes.values()) + balance.pending


def test_frames_are_delivered_in_order_by_one_thread(line: Line) -> None:
    line.worker.start(line.process)
    for number in (1, 2, 3):
        line.feed(number)
    assert line.delivered == [1, 2, 3]
    assert len(line.threads) == 1
    assert line.count(Outcome.DETECTED) == 3


def test_a_newer_frame_replaces_the_one_that_waits(line: Line) -> None:
    line.worker.start(line.process)
    line.hold(1)
    for number in (2, 3, 4):
        line.worker.offer(number)
    assert line.worker.balance().pending == 2
    line.gate.set()
    assert line.ended.acquire(timeout=PATIENCE_S)
    assert line.ended.acquire(timeout=PATIENCE_S)
    assert line.delivered == [1, 4]
    assert line.count(Outcome.STALE) == 2


def test_before_start_frames_are_inactive(line: Line) -> None:
    line.worker.offer(1)
    assert line.count(Outcome.INACTIVE) == 1


def test_a_skipped_frame_is_only_counted(line: Line) -> None:
    line.worker.start(line.process)
    line.worker.offer(1, skip=True)
    line.feed(2)
    assert line.delivered == [2]
    assert line.count(Outcome.SKIPPED) == 1


@pytest.mark.parametrize(
    ("number", "outcome", "message"),
    [
        pytest.param(-1, Outcome.REJECTED, "-1 is no image", id="unreadable"),
        pytest.param(0, Outcome.FAILED, "zero", id="inference-error"),
    ],
)
def test_a_bad_frame_is_counted_and_the_next_one_detected(
    line: Line, number: int, outcome: Outcome, message: str
) -> None:
    line.worker.start(line.process)
    line.feed(number)
    line.feed(7)
    assert line.failures == [(outcome, message)]
    assert line.count(outcome) == 1
    assert line.delivered == [7]


def test_stop_waits_for_the_frame_in_work_and_flushes_the_waiting_one(line: Line) -> None:
    line.worker.start(line.process)
    line.hold(1)
    line.worker.offer(2)
    opener = threading.Timer(0.05, line.gate.set)
    opener.start()
    assert line.worker.stop(PATIENCE_S)
    assert line.delivered == [1]
    assert line.count(Outcome.FLUSHED) == 1
    assert line.worker.balance().pending == 0


def test_the_time_spent_on_the_current_frame_is_reported(line: Line) -> None:
    assert line.worker.busy_s() == 0
    line.worker.start(line.process)
    line.hold(1)
    assert 0 < line.worker.busy_s() < line.worker.busy_s()
    line.gate.set()
    assert line.ended.acquire(timeout=PATIENCE_S)
    assert line.worker.busy_s() == 0


def test_a_hung_frame_is_abandoned_and_its_late_result_dropped(line: Line) -> None:
    line.worker.start(line.process)
    line.hold(1)
    assert line.worker.abandoned_threads() == 0
    assert not line.worker.stop(0.01)
    assert line.worker.abandoned_threads() == 1
    assert line.count(Outcome.FAILED) == 1
    (hung,) = (thread for thread in threading.enumerate() if thread.ident in line.threads)
    line.gate.set()
    hung.join(PATIENCE_S)
    assert line.delivered == []
    assert line.worker.abandoned_threads() == 0
    line.worker.start(line.process)
    line.feed(2)
    assert line.delivered == [2]
    assert len(line.threads) == 2


def test_a_new_process_takes_over_at_the_next_frame(line: Line) -> None:
    line.worker.start(line.process)
    line.feed(1)
    line.worker.start(lambda number: lambda: line.delivered.append(-number))
    line.feed(2)
    assert line.delivered == [1, -2]


def test_rest_ends_when_the_frame_in_work_does_although_frames_go_on(line: Line) -> None:
    line.worker.start(line.process)
    line.hold(1)
    assert not line.worker.rest(0.01)
    line.worker.offer(2)
    line.worker.offer(3)
    opener = threading.Timer(0.05, line.gate.set)
    opener.start()
    assert line.worker.rest(PATIENCE_S)
    assert 1 in line.delivered


def test_rest_without_work_returns_at_once(line: Line) -> None:
    assert line.worker.rest(0.0)


def test_close_reports_an_abandoned_thread(line: Line) -> None:
    line.worker.start(line.process)
    line.hold(1)
    assert not line.worker.close(0.01)
    line.gate.set()


def test_close_ends_the_thread(line: Line) -> None:
    line.worker.start(line.process)
    line.feed(1)
    assert line.worker.close(PATIENCE_S)
    assert not {thread.ident for thread in threading.enumerate()} & line.threads
