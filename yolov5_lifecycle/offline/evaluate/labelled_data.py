"""Labelled images for an evaluation: a YOLO folder, a COCO file or a recording with corrected detections."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from yolov5_lifecycle.evaluation.coco_file import read_coco_file
from yolov5_lifecycle.evaluation.ground_truth import (
    MAX_CLASSES,
    MAX_IMAGES,
    MAX_OBJECTS,
    PROGRESS_PERIOD,
    Boxes,
    DataError,
    Labels,
    Problems,
    check_box_count,
    check_count,
)
from yolov5_lifecycle.evaluation.yolo_folder import YAML_SUFFIXES, read_yolo_folder
from yolov5_lifecycle.images.image import ImageError
from yolov5_lifecycle.models.class_names import ClassNamesError, safe_name
from yolov5_lifecycle.offline.evaluate.arguments import DataOptions
from yolov5_lifecycle.offline.evaluate.evaluating import LabelledData, LabelledImage
from yolov5_lifecycle.offline.image_files import ImageFile
from yolov5_lifecycle.offline.recordings import is_recording
from yolov5_lifecycle.offline.terminal import missing_images

if TYPE_CHECKING:
    from yolov5_lifecycle.offline.recording import Recording, Stamp
    from yolov5_lifecycle.offline.stored_messages import StoredTopic

_DETECTIONS = "vision_msgs/msg/Detection2DArray"
_LABEL_INFO = "vision_msgs/msg/LabelInfo"
_MAX_PX = 1e6


def kind_of(source: Path) -> str:
    """`YOLO`, `COCO` or `recording`; raises DataError for anything else."""
    if source.suffix.lower() == ".json" and not source.is_dir():
        return "COCO"
    if source.suffix.lower() in YAML_SUFFIXES and not source.is_dir():
        return "YOLO"
    if is_recording(source):
        return "recording"
    if source.is_dir():
        return "YOLO"
    raise DataError(
        f"{source}: expected a folder with images/ and labels/, its data.yaml, a COCO file (.json), or a "
        "recording with images and Detection2DArrays."
    )


@contextmanager
def labelled_data(source: Path, options: DataOptions, problems: Problems) -> Iterator[LabelledData]:
    """Open the data set `source`. Problems with single images are added to `problems`.

    Raises DataError if nothing can be used, RecordingError, and ImportError without rosbags.
    """
    kind = kind_of(source)
    if kind == "recording":
        from yolov5_lifecycle.offline.recording import open_recording  # rosbags is an extra

        with open_recording(source) as recording:
            yield _labelled_recording(recording, options, problems)
        return
    if kind == "COCO":
        folder = read_coco_file(source, problems, root=options.root)
    else:
        folder = read_yolo_folder(source, problems, split=options.split, root=options.root)
    images = [
        LabelledImage(number, ImageFile(path), labels) for number, (path, labels) in enumerate(folder.images)
    ]
    yield LabelledData(kind, folder.class_names, len(images), lambda: images)


def _labelled_recording(recording: Recording, options: DataOptions, problems: Problems) -> LabelledData:
    """Images and detections of `recording`; those with one stamp in their headers belong together.

    The classes are those of the `label_info` of the same node, if it has one, else those that occur. Raises
    RecordingError, and DataError if there are no detections that can be used, or more than the limits.
    """
    topic = recording.image_topic(options.topic)
    if not (topics := recording.topics(_DETECTIONS)):
        raise DataError(
            f"{recording.path}: there are no detections ({_DETECTIONS}) in it to compare with. Record the "
            "corrected detections together with the images, or merge both recordings with `ros2 bag convert`."
        )
    truth = recording.one_of(topics, options.truth_topic, what="detection topic", option="--truth-topic")
    class_names = _label_info(recording, truth, problems)
    class_ids = {name: index for index, name in enumerate(class_names)}
    labels = _labels(recording, truth, class_ids, not class_ids, problems)
    if not labels:
        raise DataError(
            f"{recording.path}: none of {truth.count} messages on {truth.name} can be used. "
            f"{problems.summary}".strip()
        )
    told = iter([problems])  # the images without labels are counted once

    def images() -> Iterator[LabelledImage]:
        return _images(recording, topic, labels, next(told, Problems(lambda _: None)))

    return LabelledData("recording", tuple(class_ids), min(topic.count, len(labels)), images)


def _label_info(recording: Recording, truth: StoredTopic, problems: Problems) -> tuple[str, ...]:
    """The class names of the LabelInfo in the namespace of `truth`, or of the only one; else none."""
    topics = recording.topics(_LABEL_INFO)
    near = [topic for topic in topics if truth.name.startswith(f"{topic.name.rpartition('/')[0]}/")]
    near.sort(key=lambda topic: len(topic.name), reverse=True)
    for topic in near or (topics if len(topics) == 1 else []):
        for recorded in recording.messages(topic):
            try:
                class_map = recorded.message.class_map
                if len(class_map) > MAX_CLASSES:
                    raise DataError(f"found {len(class_map)} classes, more than {MAX_CLASSES}")
                names = {int(one.class_id): safe_name(str(one.class_name)) for one in class_map}
            except (ImageError, DataError, ClassNamesError) as error:
                problems.add("unusable entries", topic.name, error)
                continue
            return tuple(dict.fromkeys(names[class_id] for class_id in sorted(names)))
    return ()


def _labels(
    recording: Recording, topic: StoredTopic, class_ids: dict[str, int], may_add: bool, problems: Problems
) -> dict[Stamp, Labels]:
    """The labels by stamp. If `may_add`, class names that are new are added to `class_ids`."""
    labels: dict[Stamp, Labels] = {}
    seen: Counter[Stamp] = Counter()
    objects = 0
    for recorded in recording.messages(topic):
        check_count(recording.path, f"messages on {topic.name[:200]}", recorded.number + 1, MAX_IMAGES)
        if recorded.number % PROGRESS_PERIOD == 0:
            problems.progress(f"labels: {recorded.number} messages")
        try:
            stamp = recorded.stamp
            seen[stamp] += 1
            if seen[stamp] > 1:
                raise DataError("other detections have the same stamp: which image they are of is unknown")
            boxes = _boxes(recorded.message.detections, class_ids, may_add=may_add)
        except (ImageError, DataError, ClassNamesError) as error:
            problems.add("broken labels", recorded.label, error)
            continue
        labels[stamp] = Labels(boxes)
        objects += len(boxes)
        check_count(recording.path, "objects in a data set", objects, MAX_OBJECTS)
    return {stamp: found for stamp, found in labels.items() if seen[stamp] == 1}


def _boxes(detections: Any, class_ids: dict[str, int], *, may_add: bool) -> Boxes:
    check_box_count(len(detections))
    names = []
    for detection in detections:
        if not len(detection.results):
            raise DataError("a detection has no class")
        best = max(detection.results, key=lambda result: result.hypothesis.score)
        names.append(safe_name(best.hypothesis.class_id))
        if may_add and len(class_ids) < MAX_CLASSES:
            class_ids.setdefault(names[-1], len(class_ids))
        if names[-1] not in class_ids:
            raise DataError(f"the class '{names[-1][:40]}' is not in its label_info")
    boxes = [detection.bbox for detection in detections]
    centres = np.array([(box.center.position.x, box.center.position.y) for box in boxes]).reshape(-1, 2)
    sizes = np.array([(box.size_x, box.size_y) for box in boxes]).reshape(-1, 2)
    if not (np.abs([centres, sizes]) <= _MAX_PX).all():  # NaN is not, either
        raise DataError("a box has coordinates that are not finite")
    if not (sizes > 0).all():
        width, height = sizes[(sizes <= 0).any(axis=1)][0]
        raise DataError(f"a box has a size of {width:g} x {height:g} pixels")
    corners = np.concatenate((centres - sizes / 2, centres + sizes / 2), axis=1)
    return Boxes.of(corners, [class_ids[name] for name in names])


def _images(
    recording: Recording, topic: StoredTopic, labels: dict[Stamp, Labels], problems: Problems
) -> Iterator[LabelledImage]:
    """The images that have labels, numbered."""
    received = 0
    seen: set[Stamp] = set()
    for recorded in recording.messages(topic):
        received += 1
        try:
            stamp = recorded.stamp
        except ImageError as error:
            problems.add("unusable images", recorded.label, error)
            continue
        if stamp not in labels:
            problems.add("images without labels", recorded.label, "there are no detections with its stamp")
        elif stamp in seen:
            problems.add("unusable images", recorded.label, "another image has the same stamp")
        else:
            yield LabelledImage(len(seen), recorded, labels[stamp])
            seen.add(stamp)
    if missing := max(topic.count - received, 0):
        told = missing_images(topic.count, received)
        problems.add("missing images", recording.path, told, count=missing)
