"""Whose frame is next, whatever the cameras do: in turns, and none waits for another twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from random import Random

from hypothesis import given
from hypothesis import strategies as st

from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.streaming.pipeline import Networks, Send
from yolov5_lifecycle.streaming.schedule import Job, Schedule, Slot


class Unused:
    """A pipeline that is not asked for anything."""

    def __init__(self, networks: Networks) -> None:
        self.networks = networks

    def detect(self, number: int, network: object) -> int:
        raise AssertionError("no thread runs")

    def messages(self, result: int) -> Iterator[Send]:
        raise AssertionError("no thread runs")


class Turns:
    """A schedule without a thread; cameras are numbers, and so are their frames."""

    def __init__(self, cameras: int) -> None:
        self.abandoned: list[Job[int, int]] = []
        self.schedule: Schedule[int, int] = Schedule(clock=lambda: 0.0, on_abandoned=self.abandoned.append)
        self.slots = [_slot() for _ in range(cameras)]
        networks = Networks(object())
        for slot in self.slots:
            slot.start(Unused(networks), 0.0)

    def offer(self, camera: int) -> None:
        with self.schedule.lock:
            self.schedule.offer(self.slots[camera], camera)

    def serve(self) -> list[int]:
        """Do one job; return its camera, [] if none waits."""
        with self.schedule.lock:
            job = self.schedule.begin()
            if job is None:
                return []
            self.schedule.end(job)
            return [self.slots.index(job.slot)]

    def waiting(self) -> set[int]:
        return {self.slots.index(slot) for slot in self.schedule.waiting}


def _slot() -> Slot[int, int]:
    return Slot(on_failure=lambda outcome, error: None, on_success=lambda: None)


SERVE = -1
MAX_CAMERAS = 6
STEPS = st.lists(st.integers(SERVE, MAX_CAMERAS - 1), max_size=80)
"""What happens: a frame of the camera of that number arrives, or the thread is free."""


@given(
    cameras=st.integers(1, MAX_CAMERAS),
    jobs=st.integers(0, 50),
    seed=st.integers(0, 1000),
)
def test_cameras_that_always_have_a_frame_are_served_equally_often(
    cameras: int, jobs: int, seed: int
) -> None:
    turns, order = Turns(cameras), Random(seed)
    served = Counter(dict.fromkeys(range(cameras), 0))
    for _ in range(jobs):
        for camera in order.sample(range(cameras), cameras):
            turns.offer(camera)
        served.update(turns.serve())
    assert max(served.values()) - min(served.values()) <= 1


@given(steps=STEPS)
def test_a_waiting_frame_is_overtaken_at_most_once_by_each_camera(steps: list[int]) -> None:
    turns = Turns(MAX_CAMERAS)
    overtaken: dict[int, Counter[int]] = {}
    for step in steps:
        if step == SERVE:
            served = turns.serve()
            for camera in served:
                overtaken.pop(camera, None)
            for by_camera in overtaken.values():
                by_camera.update(served)
                assert max(by_camera.values()) == 1
        else:
            turns.offer(step)
            overtaken.setdefault(step, Counter())
        assert overtaken.keys() == turns.waiting()


def test_a_fast_camera_delays_a_slow_one_by_one_job() -> None:
    turns = Turns(2)
    fast, slow = 0, 1
    turns.offer(fast)
    for _ in range(20):
        assert turns.serve() == [fast]
        turns.offer(slow)
        turns.offer(fast)
        assert turns.serve() == [slow]
        assert turns.serve() == [fast]
        turns.offer(fast)


@given(steps=STEPS)
def test_cameras_without_frames_change_nothing(steps: list[int]) -> None:
    few, many = Turns(MAX_CAMERAS), Turns(2 * MAX_CAMERAS)
    for step in steps:
        if step == SERVE:
            assert few.serve() == many.serve()
        else:
            few.offer(step)
            many.offer(step)


def test_an_abandoned_job_is_no_rest_for_whoever_waits_for_it() -> None:
    turns = Turns(1)
    turns.offer(0)
    schedule = turns.schedule
    with schedule.lock:
        job = schedule.begin()
        assert job is not None
        assert not schedule.wait([job], 0.0)
        assert not schedule.wait_or_abandon([job], 0.0)
        assert not schedule.wait([job], 0.0)
        assert not schedule.wait_or_abandon([job], 0.0)
    assert turns.abandoned == [job]
    assert turns.slots[0].counter.balance()[Outcome.FAILED] == 1


def test_the_time_of_all_jobs_that_are_awaited_begins_at_once() -> None:
    turns = Turns(3)
    networks = Networks(object(), [object(), object()])
    for camera, slot in enumerate(turns.slots):
        slot.start(Unused(networks), 0.0)
        turns.offer(camera)
    schedule = turns.schedule
    with schedule.lock:
        jobs = [job for job in (schedule.begin(), schedule.begin()) if job is not None]
        assert schedule.begin() is None
        assert not schedule.wait(jobs, 0.0)
    assert [job.awaited_s for job in jobs] == [0.0, 0.0]
