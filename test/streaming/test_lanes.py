"""Frames of different cameras run at the same time, each in its own network; a lone one has all threads."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from support.scripted_camera import PATIENCE_S, ScriptedCamera

from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.streaming.inference_threads import InferenceThreads

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
            camera.gate.clear()
            camera.offer(1)
        first.open()
        for camera in (second, third):
            assert camera.entered.wait(PATIENCE_S)

    def open(self) -> None:
        for camera in self.all:
            camera.open()


@pytest.fixture
def cameras() -> Iterator[Cameras]:
    cameras = Cameras()
    yield cameras
    cameras.open()
    cameras.inference.close(PATIENCE_S)


def test_a_lone_frame_has_the_network_for_all_processors(cameras: Cameras) -> None:
    for number in range(1, 4):
        cameras.all[0].feed(number)
    assert cameras.all[0].used == [WHOLE] * 3
    assert len(set(cameras.all[0].threads)) == 1


def test_no_other_frame_begins_beside_one_that_has_all_processors(cameras: Cameras) -> None:
    first, second, *_ = cameras.all
    first.hold(1)
    second.offer(1)
    assert second.balance().pending == 1
    assert second.used == []


def test_frames_that_wait_together_run_at_the_same_time_in_networks_of_their_own(cameras: Cameras) -> None:
    cameras.begin_two()
    _, second, third, _ = cameras.all
    assert {*second.used, *third.used} == {LEFT, RIGHT}
    assert second.threads[-1] != third.threads[-1]


def test_no_more_frames_run_at_the_same_time_than_there_are_networks(cameras: Cameras) -> None:
    cameras.begin_two()
    _, second, third, fourth = cameras.all
    fourth.offer(1)
    assert fourth.used == []
    second.open()
    fourth.wait()
    assert fourth.used == second.used
    assert third.balance().pending == 1


def test_the_next_frame_of_a_camera_waits_for_the_one_before(cameras: Cameras) -> None:
    cameras.begin_two()
    _, second, third, _ = cameras.all
    second.offer(2)
    third.open()
    third.wait()
    assert second.balance().pending == 2
    second.open()
    second.wait()
    second.wait()
    assert second.published == [1, 2]


@pytest.mark.parametrize("is_hung", [False, True], ids=["that ends", "that hangs"])
def test_close_waits_for_every_thread_and_counts_each_frame_once(cameras: Cameras, is_hung: bool) -> None:
    cameras.begin_two()
    _, second, third, fourth = cameras.all
    fourth.offer(1)
    third.open()
    third.wait()  # then the fourth runs
    fourth.wait()
    if not is_hung:
        second.open()
    assert cameras.inference.close(0.0 if is_hung else PATIENCE_S) is not is_hung
    assert second.counts() == ({Outcome.FAILED: 1} if is_hung else {Outcome.DETECTED: 1})
    assert cameras.inference.is_at_rest
    assert cameras.inference.hanging == is_hung


def test_close_abandons_every_hung_thread(cameras: Cameras) -> None:
    cameras.begin_two()
    assert not cameras.inference.close(0.01)
    assert cameras.inference.hanging == 2
    assert [camera.counts() for camera in cameras.all[1:3]] == [{Outcome.FAILED: 1}] * 2


def test_in_a_pause_all_frames_come_to_rest(cameras: Cameras) -> None:
    cameras.begin_two()
    with cameras.inference.paused():
        cameras.all[3].offer(1)
        cameras.open()
        assert cameras.inference.rest(PATIENCE_S)
        assert cameras.all[3].used == []
    cameras.all[3].wait()
    assert cameras.all[3].published == [1]
