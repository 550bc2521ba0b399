"""The thread that decides and writes: it never makes a frame wait, and tells what it does not keep."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.candidates import candidate, frames_of, look_of, rules
from support.gate import PATIENCE_S, Gate

from yolov5_lifecycle.collecting import collector as module
from yolov5_lifecycle.collecting.candidate import Detail, Origin, Pace, Trigger
from yolov5_lifecycle.collecting.collected_files import CollectedFrame
from yolov5_lifecycle.collecting.collected_folder import CollectedFolder, Quota
from yolov5_lifecycle.collecting.collector import MAX_WAITING, MAX_WAITING_BYTES, RETRY_S, Collector
from yolov5_lifecycle.images.image import ColourImage

QUOTA = Quota(max_bytes=1 << 30, max_frames=1000, min_free_bytes=0)


class Clock:
    """Each call is `step_s` after the last one."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.step_s = 0.0

    def __call__(self) -> float:
        self.now_s += self.step_s
        return self.now_s


class Disk:
    """A folder that can be made to block or fail; `collector` writes into it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.gate = Gate(is_open=True)
        self.failures: list[str] = []
        self.quota = QUOTA
        self.clock = Clock()
        self.collector = Collector(self.open, clock=self.clock)

    def open(self) -> CollectedFolder:
        self.gate.passed()
        if self.failures:
            raise OSError(self.failures.pop())
        return CollectedFolder(self.path, self.quota)

    def settled(self) -> list[CollectedFrame]:
        """What is kept after the collector has written everything."""
        assert self.collector.close(PATIENCE_S)
        return frames_of(self.path)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    disk = Disk(tmp_path)
    yield disk
    disk.gate.open()
    assert disk.collector.close(PATIENCE_S)


def test_a_frame_with_a_reason_is_kept_with_it(disk: Disk) -> None:
    disk.collector.offer(
        candidate(reasons={Trigger.CLASS: Detail("cat"), Trigger.UNCERTAIN: Detail("cat 0.26")})
    )
    (frame,) = disk.settled()
    reasons = {"class": "cat", "uncertain": "cat 0.26", "novel": "the first of its kind"}
    assert frame.reasons == reasons
    assert frame.value == 20
    status = disk.collector.status
    assert (status.kept, status.frames, status.problem) == (1, 1, "")
    assert status.megabytes > 0


def test_a_frame_without_reason_is_kept_only_if_it_is_novel(disk: Disk) -> None:
    looks = [look_of(0), look_of(0) + 0.2 * look_of(1), look_of(2)]
    for look in looks:
        disk.collector.offer(candidate(reasons={}, embedding=look))
    kept = disk.settled()
    assert [[*frame.reasons] for frame in kept] == [["novel"], ["novel"]]
    assert "distance" in kept[1].reasons["novel"]


def test_a_frame_without_a_look_is_never_novel(disk: Disk) -> None:
    """That of an export to ONNX, whose features nobody knows."""
    disk.collector.offer(candidate(reasons={}, embedding=np.empty(0, np.float32)))
    disk.collector.offer(candidate(embedding=np.empty(0, np.float32)))
    assert [[*frame.reasons] for frame in disk.settled()] == [["class"]]


def test_near_duplicates_are_not_kept_unless_somebody_asked_for_them(disk: Disk) -> None:
    near = look_of(0) + 0.01 * look_of(1)
    disk.collector.offer(candidate(embedding=look_of(0)))
    disk.collector.offer(candidate(embedding=near))
    disk.collector.offer(candidate(embedding=near, reasons={Trigger.REQUESTED: Detail("~/collect")}))
    disk.collector.offer(candidate(1, embedding=near))  # another picture, as the model does not see
    assert [next(iter(frame.reasons)) for frame in disk.settled()] == ["class", "requested", "class"]
    assert (disk.collector.status.kept, disk.collector.status.duplicates) == (3, 1)


def test_frames_of_a_camera_have_a_gap_between_them_and_those_of_others_do_not_count(disk: Disk) -> None:
    front, rear = Pace(), Pace()
    disk.collector.offer(candidate(0, pace=front))
    disk.collector.offer(candidate(1, pace=front))
    disk.collector.offer(candidate(2, pace=rear))
    disk.collector.offer(candidate(3, pace=front, reasons={Trigger.REQUESTED: Detail("")}))
    assert len(disk.settled()) == 3


@pytest.mark.parametrize(
    ("per_minute", "step_s", "room", "kept"),
    [
        pytest.param(0.0, 10.0, 7, [5, 4, 7, 6, 8, 9, 3], id="no limit"),
        pytest.param(0.6, 10.0, 7, [7, 8, 9], id="the best of five minutes"),
        pytest.param(0.6, 10.0, 3, [7, 8, 9], id="in a folder that is full at the same time"),
        pytest.param(0.6, 125.0, 7, [5, 4, 7, 6, 8, 9, 3], id="fewer in five minutes"),
        pytest.param(0.1, 150.0, 7, [9], id="the best of ten minutes"),
    ],
)
def test_of_the_frames_of_some_minutes_the_best_are_kept(
    disk: Disk, per_minute: float, step_s: float, room: int, kept: list[float]
) -> None:
    few, pace, disk.clock.step_s = rules(per_minute=per_minute), Pace(), step_s
    disk.quota = replace(QUOTA, max_frames=room)
    for seed, value in enumerate([5, 4, 7, 6, 8, 9, 3]):
        reasons = {Trigger.UNUSUAL: Detail("", value / 10)}
        disk.collector.offer(candidate(seed, rules=few, pace=pace, reasons=reasons))
    assert [frame.value for frame in disk.settled()] == kept
    assert disk.collector.status.dropped == 0


def test_a_slow_disk_delays_no_frame_and_what_is_lost_is_counted(disk: Disk) -> None:
    disk.gate.close()
    disk.collector.offer(candidate(0))
    disk.gate.wait_until_reached()
    for seed in range(1, MAX_WAITING + 5):
        disk.collector.offer(candidate(seed))
    assert disk.collector.status.dropped == 4
    disk.gate.open()
    assert len(disk.settled()) == 1 + MAX_WAITING


def test_large_frames_that_wait_have_a_bound_of_memory(disk: Disk) -> None:
    disk.gate.close()
    disk.collector.offer(candidate(0))
    disk.gate.wait_until_reached()
    side = 4096
    large = ColourImage(np.zeros((side, side, 3), np.uint8), "bgr")
    for _ in range(MAX_WAITING):
        disk.collector.offer(candidate(1, image=large))
    fitting = MAX_WAITING_BYTES // large.pixels.nbytes
    assert disk.collector.status.dropped == MAX_WAITING - fitting > 0


def test_one_frame_larger_than_the_bound_is_taken_alone(disk: Disk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_WAITING_BYTES", 10)
    disk.collector.offer(candidate(0))
    assert len(disk.settled()) == 1


def test_a_disk_that_fails_is_told_once(disk: Disk, caplog: pytest.LogCaptureFixture) -> None:
    disk.failures = ["No space left\x1b[31m on device"] * 3
    disk.clock.step_s = RETRY_S
    with caplog.at_level(logging.WARNING):
        for seed in range(3):
            disk.collector.offer(candidate(seed))
        assert disk.settled() == []
    assert disk.failures == []
    assert [record.getMessage() for record in caplog.records] == [
        "no images are collected: No space left?[31m on device"
    ]
    assert disk.collector.status.problem == "No space left?[31m on device"
    assert disk.collector.status.dropped == 3


def test_what_nobody_expected_does_not_end_the_thread(disk: Disk, caplog: pytest.LogCaptureFixture) -> None:
    disk.clock.step_s = RETRY_S
    disk.collector.offer(candidate(0, origin=Origin("x" * 2000, 1, 2)))  # longer than a record takes
    disk.collector.offer(candidate(1))
    assert len(disk.settled()) == 1
    assert "unexpected ValidationError while an image was collected" in caplog.text
    assert (disk.collector.status.dropped, disk.collector.status.kept) == (1, 1)


def test_a_disk_that_fails_is_left_alone_for_a_while_and_then_used_again(disk: Disk) -> None:
    disk.failures = ["Input/output error"]
    disk.clock.step_s = RETRY_S / 2
    for seed in range(3):
        disk.collector.offer(candidate(seed))
    assert [frame.image[-10:] for frame in disk.settled()] == ["000001.jpg"]
    assert (disk.collector.status.dropped, disk.collector.status.kept) == (2, 1)
    assert disk.collector.status.problem == ""


def test_a_folder_that_can_be_opened_again_is_no_problem_although_nothing_is_new(disk: Disk) -> None:
    disk.clock.step_s = RETRY_S
    disk.collector.decide(candidate(0))
    disk.collector.close(PATIENCE_S)
    again = Disk(disk.path)
    again.clock.step_s = RETRY_S
    again.failures = ["another process collects into it"]
    again.collector.decide(candidate(0))
    assert again.collector.status.problem == "another process collects into it"
    again.collector.decide(candidate(0))
    assert (again.collector.status.duplicates, again.collector.status.problem) == (1, "")
    again.quota = replace(QUOTA, min_free_bytes=1 << 60)
    assert again.collector.close(PATIENCE_S)
    again.collector.decide(candidate(1))
    assert "free on the disk" in again.collector.status.problem
    again.collector.decide(candidate(0))
    assert "free on the disk" in again.collector.status.problem, "the folder could be opened"
    again.collector.close(PATIENCE_S)


def test_a_disk_that_hangs_does_not_keep_the_process(disk: Disk) -> None:
    disk.gate.close()
    disk.collector.offer(candidate())
    disk.gate.wait_until_reached()
    assert not disk.collector.close(0.01)


def test_a_collector_that_is_idle_for_long_lets_others_have_the_folder(
    disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "IDLE_S", 0.05)
    closed = threading.Event()
    close = CollectedFolder.close

    def close_and_tell(folder: CollectedFolder) -> None:
        close(folder)
        closed.set()

    monkeypatch.setattr(CollectedFolder, "close", close_and_tell)
    disk.collector.offer(candidate(0))
    assert closed.wait(PATIENCE_S)
    CollectedFolder(disk.path, QUOTA).close()
    disk.collector.offer(candidate(1))
    assert len(disk.settled()) == 2


def test_a_full_folder_counts_what_is_worth_less(disk: Disk) -> None:
    disk.quota = replace(QUOTA, max_frames=1)
    disk.collector.offer(candidate(0, reasons={Trigger.REQUESTED: Detail("")}))
    disk.collector.offer(candidate(1))
    (frame,) = disk.settled()
    assert "requested" in frame.reasons
    assert disk.collector.status.outranked == 1
