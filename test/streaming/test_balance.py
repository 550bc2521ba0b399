"""Whatever several threads do with feeds, and however frames end, every frame is counted exactly once."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Hashable, Sequence
from contextlib import suppress
from random import Random

import pytest
from support.scripted_camera import PATIENCE_S

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.streaming.pipeline import Pipeline
from yolov5_lifecycle.streaming.worker import Worker

CAMERAS = 4
OFFERS = 1500
CHANGES = 300
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
        return number


class RandomCamera:
    """A feed, what was offered to it, and what it was told."""

    def __init__(self, worker: Worker[int, int], fate: Fate) -> None:
        self.begun: list[int] = []
        self.published: list[int] = []
        self.reported: Counter[Outcome] = Counter()
        self.feed = worker.feed(on_failure=self._fail, on_success=self._succeed)
        self._fate = fate

    def detect(self, number: int) -> int:
        self.begun.append(number)
        return self._fate.meet(number)

    def publish(self, result: int) -> None:
        self.published.append(result)

    def offer_many(self) -> None:
        for number in range(1, OFFERS + 1):
            self.feed.offer(number)

    def change_often(self, random: Random) -> None:
        for _ in range(CHANGES):
            if random.random() < 0.5:
                with suppress(RuntimeError):  # it is closed
                    self.feed.start(self, max_rate_hz=random.choice([0.0, 0.0, 1e4]))
            else:
                self.feed.stop(0.0)
        if random.random() < 0.5:
            self.feed.close()

    def _fail(self, outcome: Outcome, error: Exception) -> None:
        self.reported[outcome] += 1

    def _succeed(self) -> None:
        self.reported[Outcome.DETECTED] += 1


class Together:
    """All frames may run together; they end as they would alone."""

    max_size = 3

    def key(self, pipeline: Pipeline[int, int], frame: int) -> Hashable:
        return ""

    def detect(self, jobs: Sequence[tuple[Pipeline[int, int], int]]) -> Sequence[int | Exception]:
        return [_detected(pipeline, frame) for pipeline, frame in jobs]


def _detected(pipeline: Pipeline[int, int], frame: int) -> int | Exception:
    try:
        return pipeline.detect(frame)
    except (ImageError, RuntimeError) as error:
        return error


def run_all(threads: list[threading.Thread]) -> None:
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


def inference_threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name == "inference"}


@pytest.mark.parametrize("is_batched", [False, True], ids=["alone", "in batches"])
@pytest.mark.parametrize("seed", range(4))
def test_every_frame_is_counted_once(seed: int, is_batched: bool) -> None:
    before = inference_threads()
    fate = Fate(Random(seed))
    worker: Worker[int, int] = Worker()
    worker.batch = Together() if is_batched else None
    cameras = [RandomCamera(worker, fate) for _ in range(CAMERAS)]
    run_all(
        [threading.Thread(target=camera.offer_many) for camera in cameras]
        + [
            threading.Thread(target=camera.change_often, args=(Random(f"{seed} {index}"),))
            for index, camera in enumerate(cameras)
        ]
    )
    worker.stop(0.0)
    fate.released.set()
    worker.close(PATIENCE_S)
    for thread in inference_threads() - before:
        thread.join(PATIENCE_S)
    for camera in cameras:
        balance = camera.feed.balance()
        assert balance.received == OFFERS
        assert balance.pending == 0
        assert balance[Outcome.DETECTED] == len(camera.published) == camera.reported[Outcome.DETECTED]
        assert balance[Outcome.REJECTED] == camera.reported[Outcome.REJECTED]
        assert balance[Outcome.FAILED] >= camera.reported[Outcome.FAILED]
        ended = (Outcome.DETECTED, Outcome.REJECTED, Outcome.FAILED)
        assert sum(balance[outcome] for outcome in ended) == len(camera.begun)
