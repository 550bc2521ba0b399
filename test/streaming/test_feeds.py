"""Several cameras on one inference thread: none waits for, counts or stops the frames of another."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Iterator

import pytest
from support.scripted_camera import PATIENCE_S, ScriptedCamera, when_awaited

from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.streaming.pipeline import Networks, Send
from yolov5_lifecycle.streaming.worker import Worker


class Cameras:
    """Three started cameras on one worker with a clock of its own."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.worker: Worker[int, int] = Worker(clock=lambda: self.now_s)
        self.all = [ScriptedCamera(self.worker) for _ in range(3)]
        for camera in self.all:
            camera.frames.start(camera)


@pytest.fixture
def cameras() -> Iterator[Cameras]:
    cameras = Cameras()
    yield cameras
    for camera in cameras.all:
        camera.open()
    cameras.worker.close(PATIENCE_S)
    for camera in cameras.all:
        assert camera.frames.balance().pending == 0


def test_one_thread_serves_all(cameras: Cameras) -> None:
    for number, camera in enumerate(cameras.all, 1):
        camera.feed(number)
    assert [camera.published for camera in cameras.all] == [[1], [2], [3]]
    assert len({thread for camera in cameras.all for thread in camera.threads}) == 1


def test_the_camera_served_longest_ago_is_next(cameras: Cameras) -> None:
    first, second, third = cameras.all
    order: list[str] = []
    for name, camera in (("first", first), ("second", second), ("third", third)):
        camera.frames.start(Named(name, order, camera))
    third.feed(1)
    second.feed(1)
    first.hold(1)
    for camera in (first, second, third):
        camera.offer(2)
    first.gate.set()
    for camera in (first, first, second, third):
        camera.wait()
    assert order == ["third", "second", "first", "third", "second", "first"]


class Named:
    """A pipeline that notes its name and behaves as `camera`."""

    def __init__(self, name: str, order: list[str], camera: ScriptedCamera) -> None:
        self._name = name
        self._order = order
        self._camera = camera
        self.networks = camera.networks

    def detect(self, number: int, network: object) -> int:
        self._order.append(self._name)
        return self._camera.detect(number, network)

    def messages(self, result: int) -> Iterator[Send]:
        return self._camera.messages(result)


def test_a_frame_replaces_only_one_of_its_own_camera(cameras: Cameras) -> None:
    first, second, third = cameras.all
    first.hold(1)
    for number in (2, 3):
        second.offer(number)
    third.offer(4)
    first.gate.set()
    for camera in cameras.all:
        camera.wait()
    assert (second.published, third.published) == ([3], [4])
    assert second.counts() == {Outcome.DETECTED: 1, Outcome.STALE: 1}
    assert third.counts() == {Outcome.DETECTED: 1}


def test_each_camera_has_a_rate_limit_of_its_own(cameras: Cameras) -> None:
    first, second, _ = cameras.all
    first.frames.start(first, max_rate_hz=0.001)
    for number in (1, 2):
        first.feed(number)
        second.feed(number)
    first.offer(3)
    second.feed(3)
    assert first.counts() == {Outcome.DETECTED: 2, Outcome.SKIPPED: 1}
    assert second.counts() == {Outcome.DETECTED: 3}


def test_a_failure_is_reported_to_its_camera(cameras: Cameras) -> None:
    first, second, _ = cameras.all
    first.feed(-1)
    second.feed(0)
    assert first.failures == [(Outcome.REJECTED, "-1 is no image")]
    assert second.failures == [(Outcome.FAILED, "zero")]


def test_after_a_hang_the_cameras_go_on_in_a_new_thread(cameras: Cameras) -> None:
    first, second, third = cameras.all
    first.hold(1)
    assert not cameras.worker.stop(0.01)
    for number, camera in enumerate((second, third), start=2):
        camera.frames.start(camera)
        camera.feed(number)
    assert (second.published, third.published) == ([2], [3])
    assert first.counts() == {Outcome.FAILED: 1}
    assert cameras.worker.abandoned_threads() == 1
    assert set(second.threads) == set(third.threads) != set(first.threads)
    (hung,) = (thread for thread in threading.enumerate() if thread.ident in first.threads)
    first.gate.set()
    hung.join(PATIENCE_S)
    assert not first.published
    assert not first.failures
    assert first.counts() == {Outcome.FAILED: 1}


def test_a_late_error_of_a_hung_frame_is_dropped_like_a_late_result(cameras: Cameras) -> None:
    first, second, _ = cameras.all
    first.hold(0)
    assert not cameras.worker.stop(0.01)
    second.frames.start(second)
    (hung,) = (thread for thread in threading.enumerate() if thread.ident in first.threads)
    second.hold(1)
    first.gate.set()
    hung.join(PATIENCE_S)
    assert not first.failures
    assert first.counts() == {Outcome.FAILED: 1}
    assert second.frames.balance().pending == 1


def test_the_time_is_that_of_the_own_frame(cameras: Cameras) -> None:
    first, second, _ = cameras.all
    first.hold(1)
    second.offer(2)
    cameras.now_s += 2.5
    assert first.frames.busy_s() == 2.5
    assert second.frames.busy_s() == 0


def test_rest_waits_for_the_frame_of_any_camera(cameras: Cameras) -> None:
    first, second, _ = cameras.all
    first.hold(1)
    assert not cameras.worker.rest(0.01)
    second.gate.clear()
    second.offer(2)
    when_awaited(cameras.worker, first.gate.set)
    assert cameras.worker.rest(PATIENCE_S)
    assert first.published == [1]


def test_one_stop_for_all_abandons_one_thread(cameras: Cameras) -> None:
    first, second, third = cameras.all
    for camera in cameras.all:
        camera.gate.clear()
    first.hold(1)
    second.offer(2)
    third.offer(3)
    assert not cameras.worker.stop(0.01)
    assert cameras.worker.abandoned_threads() == 1
    assert [camera.counts() for camera in cameras.all] == [
        {Outcome.FAILED: 1},
        {Outcome.FLUSHED: 1},
        {Outcome.FLUSHED: 1},
    ]
    for camera in cameras.all:
        camera.open()
        camera.frames.start(camera)
        camera.feed(4)
        assert camera.published == [4]


def test_after_close_frames_are_inactive_and_the_others_go_on(cameras: Cameras) -> None:
    first, second, _ = cameras.all
    first.feed(1)
    first.frames.close()
    first.frames.close()
    first.offer(2)
    assert first.counts() == {Outcome.DETECTED: 1, Outcome.INACTIVE: 1}
    assert first.frames.balance().received == 2
    with pytest.raises(RuntimeError, match="the feed is closed"):
        first.frames.start(first)
    second.feed(3)
    assert second.published == [3]


def test_a_frame_in_progress_ends_although_its_feed_is_closed(cameras: Cameras) -> None:
    first, _, _ = cameras.all
    first.hold(1)
    first.offer(2)
    first.frames.close()
    first.gate.set()
    first.wait()
    assert first.counts() == {Outcome.DETECTED: 1, Outcome.FLUSHED: 1}


def test_closing_the_worker_closes_every_feed(cameras: Cameras) -> None:
    first, second, third = cameras.all
    first.hold(1)
    second.offer(2)
    when_awaited(cameras.worker, first.gate.set)
    assert cameras.worker.close(PATIENCE_S)
    third.offer(3)
    late = ScriptedCamera(cameras.worker)
    late.offer(4)
    assert first.counts() == {Outcome.DETECTED: 1}
    assert second.counts() == {Outcome.FLUSHED: 1}
    assert third.counts() == late.counts() == {Outcome.INACTIVE: 1}
    for camera in (third, late):
        with pytest.raises(RuntimeError, match="the feed is closed"):
            camera.frames.start(camera)


class Buffer:
    """Pixels, which should not live longer than needed."""


class Sink:
    """A pipeline that keeps nothing."""

    networks = Networks(object())

    def detect(self, _: Buffer, network: object) -> None:
        pass

    def messages(self, result: None) -> Iterator[Send]:
        return iter(())


def test_an_idle_worker_holds_no_frame() -> None:
    ended, freed = threading.Event(), threading.Event()
    worker: Worker[Buffer, None] = Worker()
    feed = worker.feed(on_failure=lambda outcome, error: None, on_success=ended.set)
    feed.start(Sink())
    buffer = Buffer()
    weakref.finalize(buffer, freed.set)
    feed.offer(buffer)
    del buffer
    assert ended.wait(PATIENCE_S)
    assert freed.wait(PATIENCE_S)
    assert worker.close(PATIENCE_S)
