"""Many recordings of the scene, what their results hold, and workers that the test has in its hands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader, StoragePlugin

from support.detected_offline import MODEL, prepare_once
from support.recorded_scene import raw, record
from yolov5_lifecycle.offline.many_recordings.plan import Options, Plan, plan_of
from yolov5_lifecycle.offline.many_recordings.recording_task import OnImage, RecordingTask
from yolov5_lifecycle.offline.many_recordings.results import RecordingResult, Refused
from yolov5_lifecycle.offline.many_recordings.tally import RecordingsTerminal, Tally
from yolov5_lifecycle.offline.many_recordings.workers import ProcessWorker, Worker
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


def plan_for(output: Path, *, suffix: str = "", crops: bool = False, **settings: object) -> Plan:
    """The embedded model with `settings`."""
    options = Options(None, "/yolov5", images=False, masks=True, suffix=suffix, crops=crops)
    return plan_of(validated({**MODEL, **settings}), output, options)


def result_of(source: SourceRecording, plan: Plan, on_image: OnImage = lambda _: None) -> RecordingResult:
    """What a worker answers for `source`, in this process."""
    result = RecordingTask(plan, on_image, prepare=prepare_once).run(source)
    assert isinstance(result, RecordingResult)
    return result


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


class Notes(RecordingsTerminal):
    """Remembers what it is told; `on_progress` is called with each tally."""

    def __init__(self, on_progress: Callable[[Tally], object] = lambda _: None) -> None:
        super().__init__()
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


class HuntedWorker(ProcessWorker):
    """A real process, the only one; killed when it has read the first image of a recording in `prey`."""

    def __init__(self, prey: Sequence[str], seen: Callable[[], object] = lambda: None) -> None:
        super().__init__(1)
        self.killed: list[str] = []
        self._prey = list(prey)
        self._seen = seen

    def detect(self, source: SourceRecording, on_image: OnImage) -> RecordingResult | Refused:
        def hunt(images: int) -> None:
            on_image(images)
            if source.name in self._prey:
                self._prey.remove(source.name)
                self.killed.append(source.name)
                self._seen()
                self.process.kill()

        return super().detect(source, hunt)


class ScriptedWorker(Worker):
    """A worker that answers what `on_load` and `on_detect` return for it, unless they raise."""

    def __init__(
        self,
        on_load: Callable[[ScriptedWorker, Plan], Plan | Refused],
        on_detect: Callable[[ScriptedWorker, SourceRecording], RecordingResult | Refused],
    ) -> None:
        self.plans: list[Plan] = []
        self.begun: list[str] = []
        self.is_stopped = self.is_closed = False
        self._on_load, self._on_detect = on_load, on_detect

    def load(self, plan: Plan) -> Plan | Refused:
        self.plans.append(plan)
        return self._on_load(self, plan)

    def detect(self, source: SourceRecording, on_image: OnImage) -> RecordingResult | Refused:
        self.begun.append(source.name)
        on_image(1)
        return self._on_detect(self, source)

    def restart(self) -> None:
        self.is_stopped = False

    def stop(self) -> None:
        self.is_stopped = True

    def close(self) -> None:
        self.is_closed = True

    def _answer(self, method: str, argument: object, on_image: OnImage = lambda _: None) -> Any:
        raise NotImplementedError


def loaded(worker: ScriptedWorker, plan: Plan) -> Plan:
    """What a worker answers that has loaded the model."""
    return plan.chosen("torch", "fp32")


def done(worker: ScriptedWorker, source: SourceRecording) -> RecordingResult:
    """What a worker answers that has read two images."""
    return RecordingResult(recording=source.name, path=str(source.path), state="done", images=2)
