"""Whatever several threads do with sessions, and however frames end, every frame is counted exactly once."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from random import Random

import pytest
from support.gate import PATIENCE_S

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_statistics import FrameCounter, Outcome
from yolov5_lifecycle.streaming.inference_threads import CameraQueue, InferenceThreads, Send

CAMERAS = 4
THREADS = 2
"""For each camera."""
OFFERS = 400
"""Of each thread."""
SWITCH_S = 1e-5
MOMENT_S = 1e-3
ENDED = (Outcome.DETECTED, Outcome.REJECTED, Outcome.FAILED)
HUNG = 6
"""At most so many frames hang, as each takes a thread."""


class Fate:
    """How frames end: mostly well, some badly, and a few hang until `released`."""

    def __init__(self, random: Random) -> None:
        self.released = threading.Event()
        self._random = random
        self._left = threading.Semaphore(HUNG)

    def meet(self, number: int) -> int:
        chance = self._random.random()
        if chance < 0.1:
            raise ImageError("torn")
        if chance < 0.2:
            raise RuntimeError("zero")
        if chance < 0.25 and self._left.acquire(blocking=False):
            assert self.released.wait(PATIENCE_S)
            if chance < 0.225:
                raise RuntimeError("late")
        return number


class RandomCamera:
    """A pipeline, what was offered to it, and what it was told."""

    def __init__(self, fate: Fate, whole: object, parallel: Sequence[object]) -> None:
        self.whole = whole
        self.parallel = parallel
        self.counter = FrameCounter()
        self.begun: list[int] = []
        self.published: list[int] = []
        self.reported: Counter[Outcome] = Counter()
        self.ended = threading.Semaphore(0)
        self._fate = fate

    def detect(self, number: int, network: object) -> int:
        self.begun.append(number)
        return self._fate.meet(number)

    def messages(self, result: int) -> Iterator[Send]:
        yield lambda: self.published.append(result)

    def report(self, outcome: Outcome, error: Exception | None) -> None:
        self.reported[outcome] += 1
        self.ended.release()


class Sessions:
    """Sessions of the same cameras, one after the other."""

    def __init__(self, cameras: list[RandomCamera]) -> None:
        self.cameras = cameras
        self.timeouts = 0
        self._lock = threading.Lock()
        self._begin()

    def _begin(self) -> None:
        inference = InferenceThreads()
        queues = [CameraQueue(camera.counter, camera.report) for camera in self.cameras]
        for queue, camera in zip(queues, self.cameras, strict=True):
            inference.start(queue, camera)
        self.now = inference, queues

    def end(self, timeout_s: float) -> None:
        inference, _ = self.now
        self.timeouts += not inference.close(timeout_s)

    def use(self, index: int, random: Random) -> None:
        """Offer frames of a camera, and now and then change its rate or begin another session."""
        for number in range(1, OFFERS + 1):
            inference, queues = self.now
            inference.offer(queues[index], number)
            chance = random.random()
            if chance < 0.1:
                with self._lock:
                    inference, queues = self.now
                    rate_hz = random.choice([0.0, 0.0, 1e4])
                    inference.start(queues[index], self.cameras[index], max_rate_hz=rate_hz)
            elif chance < 0.13:
                with self._lock:
                    self.end(random.choice([0.0, MOMENT_S]))
                    self._begin()
            elif chance < 0.5:
                self.cameras[index].ended.acquire(timeout=MOMENT_S)


def run_all(threads: list[threading.Thread]) -> None:
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def inference_threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name == "inference"}


@pytest.fixture
def _many_switches() -> Iterator[None]:
    """Threads take turns so often that none is ever alone."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    yield
    sys.setswitchinterval(before_s)


@pytest.mark.usefixtures("_many_switches")
@pytest.mark.parametrize("parallel", [(), ("left", "middle", "right")], ids=["one at a time", "in parallel"])
@pytest.mark.parametrize("seed", range(4))
def test_every_frame_is_counted_once(seed: int, parallel: tuple[str, ...]) -> None:
    before = inference_threads()
    fate = Fate(Random(seed))
    cameras = [RandomCamera(fate, "whole", parallel) for _ in range(CAMERAS)]
    sessions = Sessions(cameras)
    run_all(
        [
            threading.Thread(target=sessions.use, args=(index, Random(f"{seed} {index} {thread}")))
            for index in range(CAMERAS)
            for thread in range(THREADS)
        ]
    )
    sessions.end(0.0)
    fate.released.set()
    for thread in inference_threads() - before:
        thread.join(PATIENCE_S)
    for camera in cameras:
        balance = camera.counter.balance()
        assert balance["received"] == THREADS * OFFERS
        assert balance["pending"] == 0
        assert balance["detected"] == len(camera.published)
        assert all(balance[outcome.value] >= camera.reported[outcome] for outcome in ENDED)
        assert sum(balance[outcome.value] for outcome in ENDED) == len(camera.begun)
    begun = sum(len(camera.begun) for camera in cameras)
    reported = sum(camera.reported.total() for camera in cameras)
    assert begun - reported <= sessions.timeouts * CAMERAS, "only abandoned frames are not reported"
