"""Whose frame is next, whatever the cameras do: in turns, and none waits for another twice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from queue import SimpleQueue
from random import Random
from threading import Thread

from hypothesis import given
from hypothesis import strategies as st

from yolov5_lifecycle.streaming.frame_statistics import FrameCounter, Outcome
from yolov5_lifecycle.streaming.inference_threads import CameraQueue, InferenceThreads, Send


class Unused:
    """A pipeline that is not asked for anything."""

    whole = "network"
    parallel: Sequence[object] = ()

    def detect(self, number: int, network: object) -> int:
        raise AssertionError("no thread runs")

    def messages(self, result: int) -> Iterator[Send]:
        raise AssertionError("no thread runs")


class Turns:
    """Inference threads of which none runs; cameras are numbers, and so are their frames."""

    def __init__(self, cameras: int) -> None:
        self.inference = InferenceThreads(clock=lambda: 0.0)
        self.inference._threads[SimpleQueue()] = Thread()  # which is never idle
        self.queues = [CameraQueue(FrameCounter(), lambda outcome, error: None) for _ in range(cameras)]
        for queue in self.queues:
            self.inference.start(queue, Unused())

    def offer(self, camera: int) -> None:
        self.inference.offer(self.queues[camera], camera)

    def serve(self) -> list[int]:
        """Do one task; return its camera, [] if none waits."""
        task = self.inference._next_task()
        if task is None:
            return []
        self.inference._end(task, Outcome.DETECTED)
        return [self.queues.index(task.queue)]

    def waiting(self) -> set[int]:
        return {camera for camera, queue in enumerate(self.queues) if queue.frame is not None}


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
