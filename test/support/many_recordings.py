"""Many recordings of the scene, what their results hold, and workers that the test has in its hands."""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader, StoragePlugin

from support.detected_offline import MODEL
from support.recorded_scene import raw, record
from yolov5_lifecycle.offline.many_recordings.plan import Plan, plan_of
from yolov5_lifecycle.offline.many_recordings.supervisor import Tally
from yolov5_lifecycle.offline.many_recordings.worker_pool import ProcessWorkers
from yolov5_lifecycle.offline.many_recordings.workers import Event, Progress
from yolov5_lifecycle.offline.recording import TYPES
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.settings.settings import validated

LONG = 60
"""Images of a recording whose worker is killed while it reads it."""


def record_drives(folder: Path, lengths: dict[str, int]) -> Path:
    """A recording of the scene for each name, with that many images, in the new `folder`."""
    folder.mkdir()
    for name, count in lengths.items():
        record(folder / name, [raw(number % 5) for number in range(count)], storage=StoragePlugin.MCAP)
    return folder


def broken(folder: Path, name: str) -> Path:
    """A folder that looks like a recording and is none."""
    (folder / name).mkdir()
    (folder / name / f"{name}.mcap").write_bytes(b"these are no messages")
    return folder / name


def plan_for(output: Path, **settings: object) -> Plan:
    """The embedded model with `settings`."""
    return plan_of(
        validated({**MODEL, **settings}), output=output, topic=None, node="/yolov5", images=False, masks=True
    )


def messages(recording: Path) -> list[tuple[str, int, bytes]]:
    """Topic, time and content of every message."""
    with Reader(recording) as reader:
        return [(one.topic, time_ns, bytes(data)) for one, time_ns, data in reader.messages()]


def found_objects(recording: Path) -> dict[str, int]:
    """The detections in a result by class, of the classes that have some."""
    counts: dict[str, int] = {}
    for topic, _, data in messages(recording):
        if topic == "/yolov5/detections":
            array: Any = TYPES.deserialize_cdr(data, "vision_msgs/msg/Detection2DArray")
            for detection in array.detections:
                name = detection.results[0].hypothesis.class_id
                counts[name] = counts.get(name, 0) + 1
    return counts


class Notes:
    """A watch that remembers what it is told; `on_progress` is called with each tally."""

    def __init__(self, on_progress: Callable[[Tally], object] = lambda _: None) -> None:
        self.remarks: list[str] = []
        self._on_progress = on_progress

    @property
    def aside(self) -> list[str]:
        """The remarks on recordings that were set aside."""
        return [remark for remark in self.remarks if ": set aside: " in remark]

    def remark(self, text: str) -> None:
        self.remarks.append(text)

    def progress(self, tally: Tally) -> None:
        self._on_progress(tally)


class HuntedWorkers(ProcessWorkers):
    """Real processes; one is killed when it has read the first image of a recording that is in `prey`."""

    def __init__(self, max_count: int, prey: Sequence[str], seen: Callable[[], object]) -> None:
        super().__init__(max_count)
        self.killed: list[str] = []
        self._prey = list(prey)
        self._seen = seen
        self._reads: dict[int, str] = {}

    def begin(self, worker: int, source: SourceRecording) -> None:
        self._reads[worker] = source.name
        super().begin(worker, source)

    def events(self, timeout_s: float) -> list[Event]:
        events = super().events(timeout_s)
        for event in events:
            name = self._reads.get(event.worker, "")
            if isinstance(event, Progress) and name in self._prey and event.worker in self.process_ids:
                self._prey.remove(name)
                self.killed.append(name)
                self._seen()
                os.kill(self.process_ids[event.worker], signal.SIGKILL)
        return events


class ScriptedWorkers:
    """Workers that answer what the test says: `on_start` and `on_begin` give the next events."""

    def __init__(
        self,
        max_count: int,
        on_start: Callable[[int, Plan], Event],
        on_begin: Callable[[int, SourceRecording], Event],
    ) -> None:
        self.max_count = max_count
        self.begun: list[tuple[int, str]] = []
        self.runtimes: list[str] = []
        self.precisions: list[str] = []
        self.is_closed = False
        self._on_start, self._on_begin = on_start, on_begin
        self._events: deque[Event] = deque()

    def start(self, plan: Plan) -> int:
        self.runtimes.append(plan.runtime)
        self.precisions.append(plan.precision)
        self._events.append(self._on_start(len(self.runtimes) - 1, plan))
        return len(self.runtimes) - 1

    def begin(self, worker: int, source: SourceRecording) -> None:
        self.begun.append((worker, source.name))
        self._events.append(self._on_begin(worker, source))

    def events(self, timeout_s: float) -> list[Event]:
        assert self._events, "nothing is going on any more"
        return [self._events.popleft()]

    def close(self) -> None:
        self.is_closed = True
