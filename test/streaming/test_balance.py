"""Whatever several threads do with feeds, and however frames end, every frame is counted exactly once."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from random import Random

import pytest
from support.scripted_camera import PATIENCE_S

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.streaming.pipeline import Networks, Send
from yolov5_lifecycle.streaming.worker import Worker

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
    """A feed, what was offered to it, and what it was told."""

    def __init__(self, worker: Worker[int, int], fate: Fate, networks: Networks) -> None:
        self.networks = networks
        self.begun: list[int] = []
        self.published: list[int] = []
        self.reported: Counter[Outcome] = Counter()
        self.timeouts: list[float] = []
        self._ended = threading.Semaphore(0)
        self.feed = worker.feed(on_failure=self._fail, on_success=self._succeed)
        self._fate = fate
        self._worker = worker

    def detect(self, number: int, network: object) -> int:
        self.begun.append(number)
        return self._fate.meet(number)

    def messages(self, result: int) -> Iterator[Send]:
        yield lambda: self.published.append(result)

    def use(self, random: Random) -> None:
        """Offer frames, and now and then start the feed or stop all; some threads close it in the end."""
        for number in range(1, OFFERS + 1):
            self.feed.offer(number)
            chance = random.random()
            if chance < 0.1:
                with suppress(RuntimeError):  # it is closed
                    self.feed.start(self, max_rate_hz=random.choice([0.0, 0.0, 1e4]))
            elif chance < 0.13:
                timeout_s = random.choice([0.0, MOMENT_S])
                if not self._worker.stop(timeout_s):
                    self.timeouts.append(timeout_s)
            elif chance < 0.5:
                self._ended.acquire(timeout=MOMENT_S)
        if random.random() < 0.2:
            self.feed.close()

    def _fail(self, outcome: Outcome, error: Exception) -> None:
        self.reported[outcome] += 1
        self._ended.release()

    def _succeed(self) -> None:
        self.reported[Outcome.DETECTED] += 1
        self._ended.release()


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
@pytest.mark.parametrize(
    "networks",
    [
        pytest.param([Networks(object()) for _ in range(CAMERAS)], id="alone"),
        pytest.param([Networks(object(), [object(), object(), object()])] * CAMERAS, id="in lanes"),
    ],
)
@pytest.mark.parametrize("seed", range(4))
def test_every_frame_is_counted_once(seed: int, networks: list[Networks]) -> None:
    before = inference_threads()
    fate = Fate(Random(seed))
    worker: Worker[int, int] = Worker()
    cameras = [RandomCamera(worker, fate, of_camera) for of_camera in networks]
    run_all(
        [
            threading.Thread(target=camera.use, args=(Random(f"{seed} {index} {thread}"),))
            for index, camera in enumerate(cameras)
            for thread in range(THREADS)
        ]
    )
    timeouts = sum(len(camera.timeouts) for camera in cameras) + (not worker.stop(0.0))
    fate.released.set()
    worker.close(PATIENCE_S)
    for thread in inference_threads() - before:
        thread.join(PATIENCE_S)
    for camera in cameras:
        balance = camera.feed.balance()
        assert balance.received == THREADS * OFFERS
        assert balance.pending == 0
        assert balance[Outcome.DETECTED] == len(camera.published)
        assert all(balance[outcome] >= camera.reported[outcome] for outcome in ENDED)
        assert sum(balance[outcome] for outcome in ENDED) == len(camera.begun)
    begun = sum(len(camera.begun) for camera in cameras)
    reported = sum(camera.reported.total() for camera in cameras)
    assert begun - reported <= timeouts * CAMERAS, "only abandoned frames are not reported"
