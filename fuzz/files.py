"""Fuzz targets: labels, data sets and drives are read or refused."""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np
from rosbags.rosbag2 import StoragePlugin
from support.recorded_scene import record, text

from yolov5_lifecycle.evaluation.coco_file import read_coco_file
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES, Boxes, DataError, Problems
from yolov5_lifecycle.evaluation.yolo_folder import parsed_labels, read_description, read_yolo_folder
from yolov5_lifecycle.offline.recording import RecordingError, open_recording
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.value_rules import MAX_CLASS_NAME

Taken = TypeVar("Taken")
_SIZE_HW = (100, 200)
_CLASSES = 3
_MESSAGES = 100


def taken(take: Callable[[], Taken], refusal: type[Exception]) -> Taken | None:
    """The result of `take`, None if it raises the `refusal`, which must be one line; others propagate."""
    try:
        return take()
    except refusal as error:
        assert str(error).isprintable(), repr(error)
        return None


@cache
def folder() -> Path:
    """Removed at the end."""
    made = Path(tempfile.mkdtemp()).resolve()
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def written(name: str, data: bytes) -> Path:
    """The file of this name in `folder()`, with `data`."""
    path = folder() / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path


def check_labels(data: bytes) -> None:
    """Expect boxes in the image, or a one-line error."""
    if labels := taken(partial(parsed_labels, data.decode(errors="replace"), _CLASSES), DataError):
        _check_boxes(labels.scaled(_SIZE_HW), _CLASSES)


def check_coco_file(data: bytes) -> None:
    """Expect boxes of the file's own classes, or a one-line error."""
    written("1.jpg", b"")
    path = written("truth.json", data)
    found = taken(partial(read_coco_file, path, Problems(_check_line), root=path.parent), DataError)
    if found is not None:
        assert found.class_names is not None
        for image in found.images:
            _check_boxes(image.boxes, len(found.class_names))


def check_description(data: bytes) -> None:
    """Expect class names and folders, or a one-line error."""
    if description := taken(partial(read_description, written("data.yaml", data)), DataError):
        names = description.class_names or ()
        assert len(names) <= MAX_CLASSES
        assert all(in_one_line(name) == name and 0 < len(name) <= MAX_CLASS_NAME for name in names)


def check_image_list(data: bytes) -> None:
    """Expect images within the folder of the list, each once, or an error and one-line problems."""
    parent = written("list/val.txt", data).parent
    (parent / "data.yaml").write_text("val: [val.txt, val.txt]\n")
    (parent / "1.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    found = taken(partial(read_yolo_folder, parent, Problems(_check_line)), DataError)
    paths = [image.path for image in found.images] if found else []
    assert len(set(paths)) == len(paths)
    assert all(path.is_relative_to(parent) for path in paths)


def check_recording(data: bytes) -> None:
    """Expect messages, or an error."""
    taken(partial(_read_recording, written("drive.mcap", data)), RecordingError)


def label_seeds() -> Iterator[bytes]:
    yield b"0 0.5 0.5 0.2 0.2\n2 .1 .1 1e-1 0.2\n"
    yield b"1 0.1 0.1 0.9 0.1 0.5 0.9\n"


def coco_seeds() -> Iterator[bytes]:
    yield json.dumps(
        {
            "images": [{"id": 1, "file_name": "1.jpg", "height": 100, "width": 200}],
            "annotations": [{"image_id": 1, "category_id": 7, "bbox": [1, 2, 30, 40], "iscrowd": 0}],
            "categories": [{"id": 7, "name": "cat"}],
        }
    ).encode()


def description_seeds() -> Iterator[bytes]:
    yield b"path: .\nval: [images/val, more.txt]\nnames: {0: cat, 1: dog}\n"
    yield b"train: a\nnames: [cat]\n"
    yield b"val: a\nnames: {0: no, 2: 0x1f, 3: '1', 4: 1:30, 5: ~, 6: .5}\n"


def image_list_seeds() -> Iterator[bytes]:
    yield b"1.jpg\r\n./1.jpg\n1.jpg\n../1.jpg\n/1.jpg\n"


def recording_seeds() -> Iterator[bytes]:
    """A recording with a text, which is small."""
    path = folder() / "seed"
    shutil.rmtree(path, ignore_errors=True)
    yield (record(path, [text()], storage=StoragePlugin.MCAP) / "seed.mcap").read_bytes()


def _read_recording(path: Path) -> None:
    with open_recording(path) as recording:
        for topic in recording.topics("std_msgs/msg/String", "sensor_msgs/msg/Image"):
            for message in islice(recording.messages(topic), _MESSAGES):
                assert isinstance(message.data, bytes)


def _check_boxes(boxes: Boxes, classes: int) -> None:
    assert np.isfinite(boxes.xyxy).all()
    assert (boxes.xyxy[:, :2] < boxes.xyxy[:, 2:]).all()
    assert all(0 <= class_id < classes for class_id in boxes.class_ids.tolist())


def _check_line(told: str) -> None:
    assert told.isprintable()
