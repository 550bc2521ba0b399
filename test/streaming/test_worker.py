"""The inference worker: newest frame first, every frame counted once."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from functools import partial

import pytest
from support.scripted_camera import PATIENCE_S, ScriptedCamera, when_awaited

from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.streaming.pipeline import Networks, Send
from yolov5_lifecycle.streaming.schedule import RateLimit
from yolov5_lifecycle.streaming.worker import Worker


class Line(ScriptedCamera):
    """A camera with a worker and a clock of its own."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.worker: Worker[int, int] = Worker(clock=lambda: self.now_s)
        super().__init__(self.worker)


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.open()
    line.worker.close(PATIENCE_S)
    balance = line.frames.balance()
    assert balance.received == sum(balance.outcomes.values()) + balance.pending


def test_frames_are_detected_and_published_in_order_by_one_thread(line: Line) -> None:
    line.frames.start(line)
    for number in (1, 2, 3):
        line.feed(number)
    assert line.published == [1, 2, 3]
    assert len(set(line.threads)) == 1
    assert line.count(Outcome.DETECTED) == 3


def test_a_newer_frame_replaces_the_one_that_waits(line: Line) -> None:
    line.frames.start(line)
    line.hold(1)
    for number in (2, 3, 4):
        line.offer(number)
    assert line.frames.balance().pending == 2
    line.gate.set()
    line.wait()
    line.wait()
    assert line.published == [1, 4]
    assert line.count(Outcome.STALE) == 2


def test_before_start_frames_are_inactive(line: Line) -> None:
    line.offer(1)
    assert line.count(Outcome.INACTIVE) == 1


def test_a_frame_above_the_rate_is_only_counted(line: Line) -> None:
    line.frames.start(line, max_rate_hz=10.0)
    line.feed(1)
    line.feed(2)
    line.offer(3)
    line.now_s += 0.1
    line.feed(4)
    assert line.published == [1, 2, 4]
    assert line.count(Outcome.SKIPPED) == 1


def test_another_rate_applies_from_the_next_frame_and_the_same_one_goes_on(line: Line) -> None:
    line.frames.start(line, max_rate_hz=0.001)
    line.feed(1)
    line.feed(2)
    line.frames.start(line, max_rate_hz=0.001)
    line.offer(3)
    line.frames.start(line, max_rate_hz=10.0)
    line.feed(4)
    assert line.published == [1, 2, 4]


def test_a_rate_limit_ends_with_the_stop(line: Line) -> None:
    for number in (1, 2):
        line.frames.start(line, max_rate_hz=0.001)
        line.feed(number)
        line.feed(number)
        assert line.worker.stop(PATIENCE_S)
    assert line.published == [1, 1, 2, 2]


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
    line.frames.start(line)
    line.feed(number)
    line.feed(7)
    assert line.failures == [(outcome, message)]
    assert line.count(outcome) == 1
    assert line.published == [7]


def test_stop_waits_for_the_frame_in_work_and_flushes_the_waiting_one(line: Line) -> None:
    line.frames.start(line)
    line.hold(1)
    line.offer(2)
    when_awaited(line.worker, line.gate.set)
    assert line.worker.stop(PATIENCE_S)
    assert line.published == [1]
    assert line.count(Outcome.FLUSHED) == 1
    assert line.frames.balance().pending == 0


def test_the_time_spent_on_the_current_frame_is_reported(line: Line) -> None:
    assert line.frames.busy_s() == 0
    line.frames.start(line)
    line.hold(1)
    line.now_s += 2.5
    assert line.frames.busy_s() == 2.5
    line.gate.set()
    line.wait()
    assert line.frames.busy_s() == 0


def test_a_hung_frame_is_abandoned_and_its_late_result_dropped(line: Line) -> None:
    line.frames.start(line)
    line.hold(1)
    assert line.worker.abandoned_threads() == 0
    assert not line.worker.stop(0.01)
    assert line.worker.abandoned_threads() == 1
    assert line.count(Outcome.FAILED) == 1
    (hung,) = (thread for thread in threading.enumerate() if thread.ident in line.threads)
    line.gate.set()
    hung.join(PATIENCE_S)
    assert line.published == []
    assert line.worker.abandoned_threads() == 0
    line.frames.start(line)
    line.feed(2)
    assert line.published == [2]
    assert len(set(line.threads)) == 2


@pytest.mark.parametrize("moment", ["publishing", "drawing"])
def test_a_frame_that_hangs_after_its_detections_are_sent_is_abandoned_as_detected(
    line: Line, moment: str
) -> None:
    line.frames.start(line)
    gate, entered = {
        "publishing": (line.publish_gate, line.publishing),
        "drawing": (line.draw_gate, line.drawing),
    }[moment]
    gate.clear()
    line.offer(1)
    assert entered.wait(PATIENCE_S)
    assert not line.worker.stop(0.0)
    assert line.counts() == {Outcome.DETECTED: 1}
    (hung,) = (thread for thread in threading.enumerate() if thread.ident in line.threads)
    gate.set()
    hung.join(PATIENCE_S)
    assert (line.published, line.drawn) == ([1], [])
    assert line.counts() == {Outcome.DETECTED: 1}


def test_a_frame_that_is_abandoned_before_it_is_published_updates_nothing(line: Line) -> None:
    asked: list[int] = []

    class Asked(Negated):
        def detect(self, number: int, network: object) -> int:
            return line.detect(number, network)

        def messages(self, result: int) -> Iterator[Send]:
            asked.append(result)
            return super().messages(result)

    line.frames.start(Asked(line.published))
    line.hold(1)
    assert not line.worker.stop(0.0)
    (hung,) = (thread for thread in threading.enumerate() if thread.ident in line.threads)
    line.gate.set()
    hung.join(PATIENCE_S)
    assert asked == []


def test_while_paused_no_frame_begins(line: Line) -> None:
    line.frames.start(line)
    with line.worker.paused(), line.worker.paused():
        line.offer(1)
        assert line.worker.is_at_rest()
        line.offer(2)
        assert line.frames.balance().pending == 1
    line.wait()
    assert line.published == [2]


def test_a_second_wait_continues_the_time_of_the_first(line: Line) -> None:
    line.frames.start(line)
    line.hold(1)
    assert not line.worker.rest(0.0)
    line.now_s += 3600
    assert not line.worker.stop(3600)  # at once: otherwise this test runs into its time limit
    line.gate.set()


class Negated:
    """Another pipeline: it publishes the number with its sign changed."""

    def __init__(self, published: list[int]) -> None:
        self.networks = Networks(self)
        self._published = published

    def detect(self, number: int, network: object) -> int:
        return -number

    def messages(self, result: int) -> Iterator[Send]:
        yield lambda: self._published.append(result)


def test_a_new_pipeline_takes_over_at_the_next_frame(line: Line) -> None:
    line.frames.start(line)
    line.feed(1)
    line.frames.start(Negated(line.published))
    line.feed(2)
    assert line.published == [1, -2]


def test_a_frame_goes_through_one_pipeline_although_another_one_comes_meanwhile(line: Line) -> None:
    line.frames.start(line)
    line.hold(1)
    line.frames.start(Negated(line.published))
    line.gate.set()
    line.wait()
    assert line.published == [1]


def fail(reason: str) -> None:
    raise RuntimeError(reason)


class Unpublishable(Negated):
    """A pipeline that detects and cannot publish."""

    def messages(self, result: int) -> Iterator[Send]:
        yield partial(fail, "no publisher")


def test_a_result_that_cannot_be_published_is_a_failed_frame(line: Line) -> None:
    line.frames.start(Unpublishable(line.published))
    line.feed(1)
    assert line.failures == [(Outcome.FAILED, "no publisher")]
    assert line.count(Outcome.FAILED) == 1


def test_rest_ends_when_the_frame_in_work_does_although_frames_go_on(line: Line) -> None:
    line.frames.start(line)
    line.hold(1)
    assert not line.worker.rest(0.01)
    line.offer(2)
    line.offer(3)
    opener = threading.Timer(0.05, line.gate.set)
    opener.start()
    assert line.worker.rest(PATIENCE_S)
    assert 1 in line.published


def test_rest_without_work_returns_at_once(line: Line) -> None:
    assert line.worker.rest(0.0)


def test_close_reports_an_abandoned_thread(line: Line) -> None:
    line.frames.start(line)
    line.hold(1)
    assert not line.worker.close(0.01)
    line.gate.set()


def test_close_ends_the_thread(line: Line) -> None:
    line.frames.start(line)
    line.feed(1)
    assert line.worker.close(PATIENCE_S)
    assert not {thread.ident for thread in threading.enumerate()} & set(line.threads)


@pytest.mark.parametrize("limit_hz", [1.0, 7.0, 10.0, 20.0, 29.0])
def test_a_stream_is_thinned_to_the_limit_within_two_percent(limit_hz: float) -> None:
    limit = RateLimit(limit_hz)
    admitted = sum(limit.admits(1000 + index / 30) for index in range(30 * 100))
    assert admitted / 100 == pytest.approx(limit_hz, rel=0.02)


def test_a_slower_stream_passes_whole() -> None:
    limit = RateLimit(10.0)
    assert all(limit.admits(index / 5) for index in range(100))


def test_zero_is_no_limit() -> None:
    limit = RateLimit(0.0)
    assert all(limit.admits(0.0) for _ in range(10))


def test_a_pause_does_not_save_up_a_burst() -> None:
    limit = RateLimit(10.0)
    limit.admits(0.0)
    admitted = sum(limit.admits(100 + index / 1000) for index in range(100))
    assert admitted <= 2
