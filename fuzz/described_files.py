"""Fuzz targets: files that describe settings, data sets, cameras and drives are read or refused."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from collections.abc import Iterator
from functools import cache, partial
from itertools import islice
from pathlib import Path

from rosbags.rosbag2 import StoragePlugin
from support.colcon_workspace import REPOSITORY
from support.recorded_scene import record, text

from fuzz.refusals import taken
from yolov5_lifecycle.evaluation.ground_truth import MAX_CLASSES, DataError, Problems
from yolov5_lifecycle.evaluation.yolo_folder import read_description, read_yolo_folder
from yolov5_lifecycle.offline.recording import Recording, RecordingError, open_recording
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.parameter_file import ParameterFileError, read_parameter_file
from yolov5_lifecycle.settings.value_rules import MAX_CLASS_NAME
from yolov5_lifecycle.sources.camera_info import read_camera_info

_CAMERA_INFO = """\
image_width: 640
image_height: 480
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320, 0, 500, 240, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.1, -0.2, 0, 0, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [500, 0, 320, 0, 0, 500, 240, 0, 0, 0, 1, 0]}
"""
_MESSAGES = 100


def check_parameter_file(data: bytes) -> None:
    """Expect parameters by node, or a one-line error."""
    nodes = taken(partial(read_parameter_file, _written("parameters.yaml", data)), ParameterFileError)
    if isinstance(nodes, ParameterFileError):
        assert str(nodes).isprintable()
        return
    assert all(pattern.startswith("/") for pattern in nodes)


def check_description(data: bytes) -> None:
    """Expect class names and folders, or a one-line error."""
    description = taken(partial(read_description, _written("data.yaml", data)), DataError)
    if isinstance(description, DataError):
        assert str(description).isprintable()
        return
    names = description.class_names or ()
    assert len(names) <= MAX_CLASSES
    assert all(in_one_line(name) == name and 0 < len(name) <= MAX_CLASS_NAME for name in names)


def check_image_list(data: bytes) -> None:
    """Expect images within the folder of the list, each once, or an error and one-line problems."""
    folder = _written("list/val.txt", data).parent
    (folder / "data.yaml").write_text("val: [val.txt, val.txt]\n")
    (folder / "1.txt").write_text("0 0.5 0.5 0.2 0.2\n")
    told: list[str] = []
    found = taken(partial(read_yolo_folder, folder, Problems(told.append)), DataError)
    assert all(line.isprintable() for line in told)
    if not isinstance(found, DataError):
        paths = [image.path for image in found.images]
        assert len(set(paths)) == len(paths)
        assert all(path.is_relative_to(folder) for path in paths)


def check_camera_info(data: bytes) -> None:
    """Expect the values of camera_info, or a one-line error."""
    path = _written("camera.yaml", data)
    known = taken(partial(read_camera_info, f"file://{path}"), ValueError)
    if isinstance(known, ValueError):
        assert str(known).isprintable()
        return
    assert len(known.projection_matrix.data) == 12


def check_recording(data: bytes) -> None:
    """Expect messages, or an error."""
    path = _written("drive.mcap", data)
    taken(partial(_read_recording, path), RecordingError)


def parameter_file_seeds() -> Iterator[bytes]:
    yield (REPOSITORY / "config" / "two_cameras.yaml").read_bytes()
    yield b"/**:\n  ros__parameters:\n    classes: [cat, 'dog']\n    front.max_rate: 0x1p3\n"


def description_seeds() -> Iterator[bytes]:
    yield b"path: .\nval: [images/val, more.txt]\nnames: {0: cat, 1: dog}\n"
    yield b"train: a\nnames: [cat]\n"
    yield b"val: a\nnames: {0: no, 2: 0x1f, 3: '1', 4: 1:30, 5: ~, 6: .5}\n"


def image_list_seeds() -> Iterator[bytes]:
    yield b"1.jpg\r\n./1.jpg\n1.jpg\n../1.jpg\n/1.jpg\n"


def camera_info_seeds() -> Iterator[bytes]:
    yield _CAMERA_INFO.encode()


def recording_seeds() -> Iterator[bytes]:
    """A recording with a text, which is small."""
    folder = _folder() / "seed"
    shutil.rmtree(folder, ignore_errors=True)
    yield (record(folder, [text()], storage=StoragePlugin.MCAP) / "seed.mcap").read_bytes()


def _read_recording(path: Path) -> None:
    with open_recording(path) as recording:
        _read_messages(recording)


def _read_messages(recording: Recording) -> None:
    for topic in recording.topics("std_msgs/msg/String", "sensor_msgs/msg/Image"):
        for message in islice(recording.messages(topic), _MESSAGES):
            assert isinstance(message.data, bytes)


@cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp()).resolve()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _written(name: str, data: bytes) -> Path:
    path = _folder() / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    return path
