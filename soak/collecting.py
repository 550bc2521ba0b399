"""Images collected by eight cameras on a disk that fills up, is protected or unplugged, and after SIGKILL."""

from __future__ import annotations

import os
import random
import signal
import subprocess
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
from std_srvs.srv import Trigger
from support.detector_process import NODE, PARAMETERS, scene_image

from soak.disk import Disk
from soak.finding import Finding, number_of, problem
from soak.subject import Sender, Subject, subject_in
from yolov5_lifecycle.collecting.collected_files import LABELS, SUFFIXES, file_of, kept_images
from yolov5_lifecycle.collecting.collector import IDLE_S, RETRY_S
from yolov5_lifecycle.ros.child_process import entry_point, own_domain

_CAMERAS = [f"camera_{number}" for number in range(1, 9)]
_MAX_MB, _DISK_MB = 1, 8
_COLLECTING: Mapping[str, object] = PARAMETERS | {
    "cameras": _CAMERAS,
    "collect": True,
    "collect_min_free_mb": 0,
    "collect_max_mb": _MAX_MB,
}
_PERIOD_S = 0.2
_SIZES = (416, 320)


class _Robot:
    """An active `subject` with eight cameras that collects into `folder`, and what sends it images."""

    def __init__(self, subject: Subject, folder: Path) -> None:
        self.subject = subject
        self.folder = folder
        self._collect = subject.observer.create_client(Trigger, f"{NODE}/collect")
        self._reloads = 0
        subject.bring_to("active")
        self.clients = [Sender(subject, name=name) for name in _CAMERAS]

    def drive(self, duration_s: float) -> None:
        """Send images of all cameras for so long, and ask for each of them."""
        for index in range(round(duration_s / _PERIOD_S)):
            self._collect.call_async(Trigger.Request())
            for client in self.clients:
                client.send(scene_image(index))
            self.subject.observer.work_for(_PERIOD_S)

    def reload(self) -> None:
        """Replace the model while images come."""
        self._reloads += 1
        answer = self.subject.begin_reload(_SIZES[self._reloads % 2])
        self._drive_until(answer.done, "an answer to a reload")
        assert all(result.successful for result in answer.result().results)

    def is_told(self, words: str) -> None:
        """Wait until the diagnostics have these words; each camera is detected nevertheless."""
        self._drive_until(lambda: words in self.subject.statuses()[""]["message"], f"'{words}'")
        self.detects()

    def detects(self) -> None:
        for client in self.clients:
            client.send_whole()

    def collects(self) -> None:
        """Wait until more images are kept, and nothing is wrong."""
        before = self._kept()
        self._drive_until(lambda: self._kept() >= before + len(_CAMERAS), "more kept images")
        self._drive_until(
            lambda: "collected" not in self.subject.statuses()[""]["message"], "an end of the problem"
        )

    def check(self) -> None:
        """Every camera is detected, and the folder has whole images only, within its quota."""
        self.detects()
        self.subject.observer.wait_for(lambda: not wrong_in(self.folder), f"{wrong_in(self.folder)} to end")
        shown = subprocess.run(
            [entry_point("collected"), "show", os.fspath(self.folder)], capture_output=True, text=True
        )
        assert shown.returncode == 0, shown.stderr
        self.subject.process.check_running()

    def _kept(self) -> int:
        return int(self.subject.statuses()[""]["images collected"])

    def _drive_until(self, condition: Callable[[], bool], what: str) -> None:
        for _ in range(60):
            self.drive(1.0)
            if condition():
                return
        raise TimeoutError(f"no {what}: {self.subject.statuses()['']}")


def wrong_in(folder: Path) -> list[str]:
    """What is not as it has to be in a folder into which nobody writes."""
    frames = [frame for _, frame in kept_images(folder)]
    wrong = [frame.image for frame in frames if not _is_whole(folder / frame.image, frame.size_wh)]
    expected = {file_of(frame.image, kind) for frame in frames for kind in SUFFIXES}
    files = {os.fspath(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    wrong += sorted(expected - files)
    wrong += sorted(path for path in files - expected if path.startswith((*SUFFIXES, ".")))
    size = sum((folder / path).stat().st_size for path in files if path != "data.yaml")
    if size > _MAX_MB * 1_000_000:
        wrong.append(f"{size} bytes in {len(frames)} images")
    return wrong


def _is_whole(path: Path, size_wh: tuple[int, int]) -> bool:
    image = cv2.imread(os.fspath(path))
    return image is not None and image.shape[1::-1] == size_wh


@contextmanager
def _robot(domain: int, folder: Path) -> Iterator[_Robot]:
    parameters = {**_COLLECTING, "collect_dir": folder}
    with subject_in(domain, parameters) as subject:
        yield _Robot(subject, folder)


def _done(step: Callable[[_Robot, Disk], None], robot: _Robot, disk: Disk) -> None:
    robot.collects()
    step(robot, disk)
    robot.reload()
    robot.collects()
    robot.check()


def _is_shared(robot: _Robot, _: Disk) -> None:
    """A second process is refused, and the first one goes on."""
    with own_domain() as domain, _robot(domain, robot.folder) as other:
        other.is_told("another process collects into it")


def _fills_up(robot: _Robot, disk: Disk) -> None:
    with disk.full():
        robot.is_told("are free on the disk")
        robot.reload()


def _is_protected(robot: _Robot, disk: Disk) -> None:
    with disk.protected():
        robot.is_told("Read-only file system")
        robot.reload()


def _is_unplugged(robot: _Robot, disk: Disk) -> None:
    with disk.unplugged():
        robot.is_told("unmounted")
        robot.reload()
        robot.drive(2 * RETRY_S)
        robot.is_told("unmounted")
        assert [*disk.path.iterdir()] == [], "something was written where the disk was mounted"


def _is_unplugged_while_idle(robot: _Robot, disk: Disk) -> None:
    robot.subject.observer.work_for(IDLE_S + 2)
    _is_unplugged(robot, disk)


def _killed(domain: int, folder: Path, after_s: float) -> None:
    """A process finds a folder that it can go on with after the last one was killed, and is killed, too."""
    with _robot(domain, folder) as robot:
        robot.collects()
        robot.check()
        robot.drive(after_s)
        robot.subject.process.stop(signal.SIGKILL)
        assert not robot.subject.escaped
    frames = [frame for _, frame in kept_images(folder)]
    images = {os.fspath(path.relative_to(folder)) for path in folder.glob("images/*/*.jpg")}
    assert {frame.image for frame in frames} == images
    assert all(_is_whole(folder / frame.image, frame.size_wh) for frame in frames)
    assert all((folder / file_of(frame.image, LABELS)).is_file() for frame in frames)


_SHARED = "a second process"
STEPS: Mapping[str, Callable[[_Robot, Disk], None]] = {
    _SHARED: _is_shared,
    "disk full": _fills_up,
    "read-only": _is_protected,
    "unplugged": _is_unplugged,
    "unplugged while idle": _is_unplugged_while_idle,
}


def collected_on_bad_disks(kills: int, seed: int, steps: Iterable[str] = tuple(STEPS)) -> Finding:
    """Take each of `steps` while a process collects, then kill it and `kills - 1` others."""
    rng = random.Random(seed)
    with own_domain() as domain, Disk(_DISK_MB) as disk:
        folder = disk.path / "collected"
        possible = [name for name in steps if disk.is_real or name == _SHARED]
        with _robot(domain, folder) as robot:
            wrong = [problem(partial(_done, STEPS[name], robot, disk)) for name in possible]
            escaped = robot.subject.escaped
            robot.subject.process.stop(signal.SIGKILL)
        lives_s = [rng.uniform(0.5, 3.0) for _ in range(kills - 1)]
        wrong += [problem(partial(_killed, domain, folder, life_s)) for life_s in lives_s]
        wrong = [told for told in wrong if told]
    skipped = "" if disk.is_real else ", nothing else without the right to mount a disk"
    return Finding(
        claim="whatever becomes of the disk, detections go on and every collected image is whole",
        done=f"{len(_CAMERAS)} cameras; {', '.join(possible)}{skipped}; {kills} SIGKILL, seed {seed}",
        result=f"{number_of('failures', wrong)}, {number_of('exceptions', escaped)}",
        limit="0, 0",
        is_met=not wrong and not escaped,
    )
