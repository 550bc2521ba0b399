"""The inference threads of a session: newest frame first, every frame counted once, a hang ends them all."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Iterator, Sequence

import pytest
from support.gate import PATIENCE_S
from support.scripted_camera import ScriptedCamera, when_awaited

from yolov5_lifecycle.streaming.frame_statistics import FrameCounter, Outcome
from yolov5_lifecycle.streaming.inference_threads import CameraQueue, InferenceThreads, Send


class Line(ScriptedCamera):
    """A started camera with inference threads and a clock of its own; `other` is a second one on them."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        super().__init__(InferenceThreads(clock=lambda: self.now_s))
        self.other = ScriptedCamera(self.inference)
        self.start()
        self.other.start()


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    for camera in (line, line.other):
        camera.open()
    line.inference.close(PATIENCE_S)
    assert (line.balance()["pending"], line.other.balance()["pending"]) == (0, 0)


def test_frames_of_all_cameras_are_detected_and_published_in_order_by_one_thread(line: Line) -> None:
    for number in (1, 2, 3):
        line.feed(number)
        line.other.feed(number)
    assert line.published == line.other.published == [1, 2, 3]
    assert len({*line.threads, *line.other.threads}) == len(line.inference._threads) == 1
    assert line.counts() == {Outcome.DETECTED: 3}


def test_a_newer_frame_replaces_only_the_one_of_its_own_camera_that_waits(line: Line) -> None:
    line.hold(1)
    line.other.offer(5)
    line.offer(2, 3, 4)
    assert line.balance()["pending"] == 2
    line.gate.open()
    for camera in (line, line, line.other):
        camera.wait()
    assert (line.published, line.other.published) == ([1, 4], [5])
    assert line.counts() == {Outcome.DETECTED: 2, Outcome.STALE: 2}


def test_the_camera_that_was_served_longest_ago_is_next_whoever_offers_first_or_most_often() -> None:
    inference, order = InferenceThreads(), list[int]()
    cameras = {number: ScriptedCamera(inference) for number in (1, 2, 3, 4)}
    for camera in cameras.values():
        camera.published = order
        camera.start()
    for held, arrivals in ((1, (1, 2, 3, 4)), (3, (3, 1, 4, 2))):
        cameras[held].hold(held)
        for number in arrivals:
            cameras[number].offer(*[number] * (5 - number))
        cameras[held].open()
        for number in (held, *arrivals):
            cameras[number].wait()
    assert order == [1, 2, 3, 4, 1, 3, 2, 4, 1, 3]
    assert inference.close(PATIENCE_S)


def test_another_rate_applies_from_the_next_frame_and_the_same_one_goes_on(line: Line) -> None:
    line.start(max_rate_hz=0.001)
    line.feed(1)
    line.feed(2)
    line.start(max_rate_hz=0.001)
    line.offer(3)
    line.start(max_rate_hz=10.0)
    line.feed(4)
    assert line.published == [1, 2, 4]


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
    line.feed(number)
    line.feed(7)
    assert (line.failures, line.other.failures) == ([(outcome, message)], [])
    assert line.counts() == {outcome: 1, Outcome.DETECTED: 1}
    assert line.published == [7]


def test_close_waits_for_the_frame_in_progress_flushes_the_waiting_ones_and_ends_the_threads(
    line: Line,
) -> None:
    line.hold(1)
    line.offer(2)
    line.other.offer(2)
    when_awaited(line.inference, line.gate.open)
    assert line.inference.close(PATIENCE_S)
    assert line.published == [1]
    line.offer(3)
    assert line.counts() == {Outcome.DETECTED: 1, Outcome.FLUSHED: 1, Outcome.INACTIVE: 1}
    assert line.other.counts() == {Outcome.FLUSHED: 1}
    assert not any(thread.is_alive() for thread in line.threads)
    with pytest.raises(RuntimeError, match="are closed; create others"):
        line.start()


def test_the_time_spent_on_the_current_frame_is_that_of_its_camera(line: Line) -> None:
    line.hold(1)
    line.other.offer(2)
    line.now_s += 2.5
    assert (line.inference.busy_s(line.queue), line.inference.busy_s(line.other.queue)) == (2.5, 0)
    line.gate.open()
    line.wait()
    assert line.inference.busy_s(line.queue) == 0


@pytest.mark.parametrize("number", [1, 0], ids=["late result", "late error"])
def test_what_hangs_is_abandoned_and_what_comes_late_dropped(line: Line, number: int) -> None:
    line.hold(number)
    line.other.offer(2)
    assert line.inference.hanging == 0
    assert not line.inference.close(0.01)
    assert not line.inference.rest(0.0)
    assert line.inference.hanging == 1
    line.gate.open()
    line.threads[0].join(PATIENCE_S)
    assert len(line.threads) == 1, "it is not asked for messages, which would update the tracker"
    assert line.inference.hanging == 0
    assert (line.published, line.failures) == ([], [])
    assert (line.counts(), line.other.counts()) == ({Outcome.FAILED: 1}, {Outcome.FLUSHED: 1})


@pytest.mark.parametrize("moment", ["publishing", "drawing"])
def test_a_frame_that_hangs_after_its_detections_are_sent_is_abandoned_as_detected(
    line: Line, moment: str
) -> None:
    gate = {"publishing": line.publishing, "drawing": line.drawing}[moment]
    gate.close()
    line.offer(1)
    gate.wait_until_reached()
    assert not line.inference.close(0.0)
    gate.open()
    line.threads[0].join(PATIENCE_S)
    assert (line.published, line.drawn) == ([1], [])
    assert line.counts() == {Outcome.DETECTED: 1}


def test_while_paused_no_frame_begins(line: Line) -> None:
    with line.inference.paused(), line.inference.paused():
        line.offer(1)
        assert line.inference.rest(0.0)
        line.offer(2)
        assert line.balance()["pending"] == 1
    line.wait()
    assert line.published == [2]


def test_a_second_wait_continues_the_time_of_the_first(line: Line) -> None:
    line.hold(1)
    assert not line.inference.rest(0.0)
    line.now_s += 3600
    assert not line.inference.close(3600)  # at once: otherwise this test runs into its time limit
    line.gate.open()
    line.threads[0].join(PATIENCE_S)


class Negated:
    """Another pipeline: it publishes the number with its sign changed."""

    whole = "another network"
    parallel: Sequence[object] = ()

    def __init__(self, published: list[int]) -> None:
        self._published = published

    def detect(self, number: int, network: object) -> int:
        return -number

    def messages(self, result: int) -> Iterator[Send]:
        yield lambda: self._published.append(result)


def test_a_new_pipeline_takes_over_at_the_next_frame(line: Line) -> None:
    line.hold(1)
    line.start(Negated(line.published))
    line.offer(2)
    line.gate.open()
    line.wait()
    line.wait()
    assert line.published == [1, -2]


def test_a_result_that_cannot_be_published_is_a_failed_frame(line: Line) -> None:
    line.published = None  # type: ignore[assignment]
    line.feed(1)
    assert line.failures == [(Outcome.FAILED, "'NoneType' object has no attribute 'append'")]
    assert line.counts() == {Outcome.FAILED: 1}


def test_rest_ends_when_the_frame_in_progress_does_although_frames_go_on(line: Line) -> None:
    line.hold(1)
    assert not line.inference.rest(0.01)
    line.offer(2, 3)
    opener = threading.Timer(0.05, line.gate.open)
    opener.start()
    assert line.inference.rest(PATIENCE_S)
    assert 1 in line.published


def test_an_idle_thread_holds_no_frame(line: Line) -> None:
    freed, pixels = threading.Event(), set[int]()
    weakref.finalize(pixels, freed.set)
    line.inference.offer(line.queue, pixels)  # which is no number: inference fails
    del pixels
    line.wait()
    assert freed.wait(PATIENCE_S)


@pytest.mark.parametrize("limit_hz", [1.0, 7.0, 29.0, 40.0, 0.0])
def test_images_are_thinned_to_the_limit_if_there_is_one(limit_hz: float) -> None:
    queue = CameraQueue(FrameCounter(), lambda outcome, error: None)
    queue.start(Negated([]), limit_hz)

    def admitted(begin_s: float, rate_hz: int, count: int) -> int:
        before = queue.counter.balance()["skipped"]
        for number in range(count):
            queue.receive(number, begin_s + number / rate_hz)
        return count - (queue.counter.balance()["skipped"] - before)

    assert admitted(1000, 30, 30 * 100) / 100 == pytest.approx(min(limit_hz or 30, 30), rel=0.02)
    burst = admitted(2000, 1000, 100)
    assert burst <= limit_hz / 10 + 2 or limit_hz == 0, "a pause saves up nothing"


# Inference streams: frames of different cameras at the same time, each in its own network

WHOLE, LEFT, RIGHT = "whole", "left", "right"


class Cameras:
    """Four started cameras whose model has two parallel networks."""

    def __init__(self) -> None:
        self.inference = InferenceThreads()
        self.all = [ScriptedCamera(self.inference, WHOLE, (LEFT, RIGHT)) for _ in range(4)]
        for camera in self.all:
            camera.start()

    def begin_two(self) -> None:
        """Return while the second and third camera have frames in progress."""
        first, second, third, _ = self.all
        first.hold(1)
        for camera in (second, third):
            camera.gate.close()
            camera.offer(1)
        first.open()
        for camera in (second, third):
            camera.gate.wait_until_reached()

    def open(self) -> None:
        for camera in self.all:
            camera.open()


@pytest.fixture
def cameras() -> Iterator[Cameras]:
    cameras = Cameras()
    yield cameras
    cameras.open()
    cameras.inference.close(PATIENCE_S)


def test_a_lone_frame_has_the_network_for_all_processors_and_no_other_begins_beside_it(
    cameras: Cameras,
) -> None:
    first, second, *_ = cameras.all
    for number in range(1, 4):
        first.feed(number)
    assert first.used == [WHOLE] * 3
    assert len(set(first.threads)) == 1
    first.hold(1)
    second.offer(1)
    assert second.balance()["pending"] == 1
    assert second.used == []


def test_frames_that_wait_together_run_at_the_same_time_as_long_as_there_are_networks(
    cameras: Cameras,
) -> None:
    cameras.begin_two()
    _, second, third, fourth = cameras.all
    assert {*second.used, *third.used} == {LEFT, RIGHT}
    assert second.threads[-1] != third.threads[-1]
    fourth.offer(1)
    assert fourth.used == []
    second.open()
    fourth.wait()
    assert fourth.used == second.used
    assert third.balance()["pending"] == 1


def test_the_next_frame_of_a_camera_waits_for_the_one_before(cameras: Cameras) -> None:
    cameras.begin_two()
    _, second, third, _ = cameras.all
    second.offer(2)
    third.open()
    third.wait()
    assert second.balance()["pending"] == 2
    second.open()
    second.wait()
    second.wait()
    assert second.published == [1, 2]


@pytest.mark.parametrize("hung", [0, 1, 2])
def test_close_waits_for_every_thread_and_counts_each_frame_once(cameras: Cameras, hung: int) -> None:
    cameras.begin_two()
    in_progress = cameras.all[1:3]
    for camera in in_progress[hung:]:
        camera.open()
        camera.wait()
    assert cameras.inference.close(0.0 if hung else PATIENCE_S) is not bool(hung)
    outcomes = [Outcome.FAILED] * hung + [Outcome.DETECTED] * (2 - hung)
    assert [camera.counts() for camera in in_progress] == [{outcome: 1} for outcome in outcomes]
    assert cameras.inference.rest(0.0) is not bool(hung)
    assert cameras.inference.hanging == hung
