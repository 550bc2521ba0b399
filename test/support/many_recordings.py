"""Many recordings of the scene, and what their results hold."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader

from support.detected_offline import MODEL, prepare_once
from support.recorded_scene import raw, record
from yolov5_lifecycle.offline.export.exporting import Export
from yolov5_lifecycle.offline.many_recordings.recording_task import OnImage, RecordingTask
from yolov5_lifecycle.offline.many_recordings.results import Plan, RecordingResult, plan_of
from yolov5_lifecycle.offline.recording import TYPES
from yolov5_lifecycle.offline.recordings import SourceRecording
from yolov5_lifecycle.settings.settings import validated

LONG = 60
"""Images of a recording whose worker is killed while it reads it."""


def record_drives(folder: Path, lengths: dict[str, int]) -> Path:
    """A recording of the scene for each name, with that many images, in the new `folder`."""
    folder.mkdir()
    for name, count in lengths.items():
        record(folder / name, [raw(number % 5) for number in range(count)])
    return folder


def plan_for(output: Path, *, suffix: str = "", crops: bool = False, **settings: object) -> Plan:
    """The embedded model with `settings`."""
    export = Export(None, suffix, crops=Path("crops") if crops else None)
    return plan_of(validated({**MODEL, **settings}), output, export)


def result_of(source: Path, plan: Plan, on_image: OnImage = lambda _: None) -> RecordingResult:
    """What a worker answers for `source`, in this process."""
    plan.output.mkdir(exist_ok=True)
    task = RecordingTask(plan, on_image, prepare=prepare_once)
    result = task.run(SourceRecording(source.stem, source))
    assert isinstance(result, RecordingResult)
    return result


def messages(recording: Path) -> list[tuple[str, int, bytes]]:
    """Topic, time and content of every message."""
    with Reader(recording) as reader:
        return [(one.topic, time_ns, bytes(data)) for one, time_ns, data in reader.messages()]


def found_objects(recording: Path) -> Counter[str]:
    """The detections in a result by class."""
    counts = Counter[str]()
    for topic, _, data in messages(recording):
        if topic == "/yolov5/detections":
            array: Any = TYPES.deserialize_cdr(data, "vision_msgs/msg/Detection2DArray")
            counts.update(one.results[0].hypothesis.class_id for one in array.detections)
    return counts


def rows(output: Path) -> dict[str, dict[str, Any]]:
    """The rows of the summary by recording."""
    return {row["recording"]: row for row in json.loads((output / "summary.json").read_text())["results"]}
