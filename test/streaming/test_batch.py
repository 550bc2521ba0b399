"""Frames of several cameras that wait at the same time run as one batch, and each ends on its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Iterator, Sequence

import pytest
from support.scripted_camera import PATIENCE_S, ScriptedCamera

from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.streaming.frame_statistics import Outcome
from yolov5_lifecycle.streaming.pipeline import Networks, Pipeline, Send
from yolov5_lifecycle.streaming.worker import Worker

Jobs = Sequence[tuple[Pipeline[int, int], int]]
Results = Sequence[int | Exception]

WITHOUT_KEY = 1000
"""For frames from this number on finding the key raises an exception."""


class Together:
    """Frames with the same last digit may run together; a result is its frame, unless `results` differs."""

    def __init__(self, max_size: int = 8) -> None:
        self.max_size = max_size
        self.batches: list[list[int]] = []
        self.keys_of: list[int] = []
        self.results: Callable[[list[int]], Results] = list
        self.gate = threading.Event()
        self.gate.set()
        self.entered = threading.Event()

    def key(self, pipeline: Pipeline[int, int], frame: int) -> Hashable:
        self.keys_of.append(frame)
        if frame >= WITHOUT_KEY:
            raise RuntimeError("no header")
        return frame % 10

    def detect(self, jobs: Jobs) -> Results:
        self.batches.append([frame for _, frame in jobs])
        self.entered.set()
        assert self.gate.wait(PATIENCE_S)
        return self.results(self.batches[-1])


class Batched:
    """A worker with a batch, a camera that keeps it busy, and four others."""

    def __init__(self) -> None:
        self.worker: Worker[int, int] = Worker()
        self.batch = Together()
        self.busy, *self.cameras = [ScriptedCamera(self.worker) for _ in range(5)]
        self.start(Networks(object(), batch=self.batch))

    def start(self, networks: Networks) -> None:
        """Let all cameras share `networks` from their next frame on."""
        for camera in (self.busy, *self.cameras):
            camera.networks = networks
            camera.frames.start(camera)

    def offer(self, *numbers: int) -> None:
        """Let the cameras wait with these frames, one each, when the worker becomes free."""
        self.busy.hold(1)
        for camera, number in zip(self.cameras, numbers, strict=False):
            camera.offer(number)
        self.busy.open()
        self.busy.wait()

    def run(self, *numbers: int) -> None:
        """Let the cameras wait with these frames, and wait until they ended."""
        self.offer(*numbers)
        for camera, _ in zip(self.cameras, numbers, strict=False):
            camera.wait()

    def hang(self, *numbers: int) -> None:
        """Return while the batch with these frames hangs."""
        self.batch.gate.clear()
        self.offer(*numbers)
        assert self.batch.entered.wait(PATIENCE_S)

    @property
    def published(self) -> list[list[int]]:
        return [camera.published for camera in self.cameras]

    @property
    def counts(self) -> list[dict[Outcome, int]]:
        return [camera.counts() for camera in self.cameras]


@pytest.fixture
def batched() -> Iterator[Batched]:
    batched = Batched()
    yield batched
    batched.batch.gate.set()
    for camera in (batched.busy, *batched.cameras):
        camera.open()
    batched.worker.close(PATIENCE_S)
    for camera in (batched.busy, *batched.cameras):
        assert camera.frames.balance().pending == 0


def test_frames_that_wait_run_together_and_are_published_by_their_own_pipelines(batched: Batched) -> None:
    batched.run(2, 12, 22, 32)
    assert batched.batch.batches == [[2, 12, 22, 32]]
    assert batched.published == [[2], [12], [22], [32]]
    assert batched.counts == [{Outcome.DETECTED: 1}] * 4


@pytest.mark.parametrize(
    ("max_size", "numbers", "batches"),
    [
        pytest.param(3, (2, 12, 22, 32), [[2, 12, 22]], id="no more than the max size"),
        pytest.param(2, (2, 12, 22, 32), [[2, 12], [22, 32]], id="the rest as another batch"),
        pytest.param(8, (2, 3, 12, 13), [[2, 12], [3, 13]], id="two keys"),
        pytest.param(8, (2, 3, 4, 5), [], id="every key once"),
        pytest.param(8, (WITHOUT_KEY, WITHOUT_KEY, 2, 12), [[2, 12]], id="key raises for two frames"),
        pytest.param(8, (WITHOUT_KEY, 2, 12), [[2, 12]], id="key raises for the next frame"),
        pytest.param(8, (2, WITHOUT_KEY, 12), [[2, 12]], id="key raises for another one"),
        pytest.param(1, (2, 12, 22), [], id="max size one"),
        pytest.param(0, (2, 12, 22), [], id="max size zero"),
    ],
)
def test_a_batch_has_waiting_frames_of_one_key_up_to_its_max_size(
    batched: Batched, max_size: int, numbers: tuple[int, ...], batches: list[list[int]]
) -> None:
    batched.batch.max_size = max_size
    batched.run(*numbers)
    assert batched.batch.batches == batches
    assert batched.published[: len(numbers)] == [[number] for number in numbers]


def test_a_single_frame_is_detected_by_its_pipeline_and_has_no_key(batched: Batched) -> None:
    batched.cameras[0].feed(2)
    assert batched.cameras[0].threads
    assert batched.batch.batches == []
    assert batched.batch.keys_of == []


def test_without_batch_every_frame_runs_alone(batched: Batched) -> None:
    batched.start(Networks(object()))
    batched.run(2, 12, 22, 32)
    assert batched.batch.batches == []
    assert batched.published == [[2], [12], [22], [32]]


def test_a_result_that_is_an_exception_is_that_of_its_own_frame(batched: Batched) -> None:
    batched.batch.results = lambda _: [2, ImageError("torn"), RuntimeError("zero"), 32]
    batched.run(2, 12, 22, 32)
    assert batched.published == [[2], [], [], [32]]
    assert [camera.failures for camera in batched.cameras] == [
        [],
        [(Outcome.REJECTED, "torn")],
        [(Outcome.FAILED, "zero")],
        [],
    ]
    assert batched.counts[1:3] == [{Outcome.REJECTED: 1}, {Outcome.FAILED: 1}]


class Unpublishable:
    """A pipeline that cannot publish."""

    def __init__(self, networks: Networks) -> None:
        self.networks = networks

    def detect(self, number: int, network: object) -> int:
        return number

    def messages(self, result: int) -> Iterator[Send]:
        raise RuntimeError("no publisher")


def test_a_result_that_cannot_be_published_is_a_failed_frame_and_the_others_are_published(
    batched: Batched,
) -> None:
    batched.cameras[0].frames.start(Unpublishable(batched.busy.networks))
    batched.run(2, 12)
    assert batched.cameras[0].failures == [(Outcome.FAILED, "no publisher")]
    assert batched.published[1] == [12]


@pytest.mark.parametrize(
    ("error", "message"),
    [
        pytest.param(RuntimeError("out of memory"), "out of memory", id="error of inference"),
        pytest.param(ImageError("torn"), "torn", id="no matter which"),
        pytest.param(None, "a batch of 3 frames returned 1 results; expected one each", id="too few results"),
    ],
)
def test_a_batch_that_fails_fails_all_its_frames(
    batched: Batched, error: Exception | None, message: str
) -> None:
    def results(_: list[int]) -> Results:
        if error is not None:
            raise error
        return [2]

    batched.batch.results = results
    batched.run(2, 12, 22)
    assert batched.published[:3] == [[], [], []]
    assert [camera.failures for camera in batched.cameras[:3]] == [[(Outcome.FAILED, message)]] * 3
    batched.batch.results = list
    batched.run(2, 12)
    assert batched.published[:2] == [[2], [12]]


def test_a_batch_that_hangs_is_abandoned_with_each_of_its_frames_counted_once(batched: Batched) -> None:
    batched.hang(2, 12, 22)
    hung, second, third, other = batched.cameras
    assert not hung.frames.stop(0.01)
    assert batched.counts[:3] == [{Outcome.FAILED: 1}] * 3
    assert second.frames.stop(0.0)
    (thread,) = (thread for thread in threading.enumerate() if thread.ident in batched.busy.threads)
    other.networks = Networks(object())
    other.frames.start(other)
    third.offer(4)
    other.offer(5)
    other.wait()
    assert third.frames.balance().pending == 1
    third.networks = Networks(object())
    third.frames.start(third)
    third.wait()
    batched.batch.gate.set()
    thread.join(PATIENCE_S)
    assert batched.published == [[], [], [4], [5]]
    assert batched.counts[:3] == [
        {Outcome.FAILED: 1},
        {Outcome.FAILED: 1},
        {Outcome.FAILED: 1, Outcome.DETECTED: 1},
    ]
    assert [camera.failures for camera in batched.cameras] == [[]] * 4


def test_the_time_of_a_batch_is_that_of_each_of_its_cameras(batched: Batched) -> None:
    batched.hang(2, 12)
    assert [camera.frames.busy_s() > 0 for camera in batched.cameras] == [True, True, False, False]


def test_a_report_of_one_camera_may_stop_another_of_the_batch(batched: Batched) -> None:
    reported = threading.Event()

    def stop_the_others(outcome: Outcome, error: Exception) -> None:
        assert all(camera.frames.stop(PATIENCE_S) for camera in batched.cameras)
        reported.set()

    first = batched.worker.feed(on_failure=stop_the_others, on_success=lambda: None)
    first.start(batched.cameras[0])
    batched.batch.results = lambda frames: [RuntimeError("zero"), *frames[1:]]
    batched.busy.hold(1)
    first.offer(2)
    batched.cameras[1].offer(12)
    batched.busy.open()
    assert reported.wait(PATIENCE_S)
    assert batched.published[1] == [12]
