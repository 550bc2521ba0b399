"""Fuzz targets: label and calibration files with any content are read correctly or refused in one line."""

from __future__ import annotations

import atexit
import json
import shutil
import tempfile
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path

import numpy as np
from support.colcon_workspace import REPOSITORY

from fuzz.refusals import taken
from yolov5_lifecycle.evaluation.coco_file import read_coco_file
from yolov5_lifecycle.evaluation.ground_truth import Boxes, DataError, Problems
from yolov5_lifecycle.evaluation.yolo_labels import parsed_labels
from yolov5_lifecycle.quantization.calibration_file import (
    read_calibration,
    write_calibration,
)
from yolov5_lifecycle.runtimes.quantization import QuantizationError

_SIZE_HW = (100, 200)
_CLASSES = 3
_CALIBRATION = REPOSITORY / "weights" / "shapes.calibration.json"
_KEPT_LAYERS = 2


def check_labels(data: bytes) -> None:
    """Expect boxes in the image, or a one-line error."""
    labels = taken(partial(parsed_labels, data.decode(errors="replace"), _CLASSES), DataError)
    if isinstance(labels, DataError):
        assert str(labels).isprintable()
        return
    _check_boxes(labels.in_pixels(_SIZE_HW), _CLASSES)


def check_coco_file(data: bytes) -> None:
    """Expect boxes of the file's own classes, or a one-line error."""
    path = _written("truth.json", data)
    folder = taken(partial(read_coco_file, path, Problems(_check_line), root=path.parent), DataError)
    if isinstance(folder, DataError):
        assert str(folder).isprintable()
        return
    assert folder.class_names is not None
    for image in folder.images:
        _check_boxes(image.labels.boxes, len(folder.class_names))


def check_calibration(data: bytes) -> None:
    """Expect a calibration with ordered ranges, or a one-line error."""
    path = _written("best.calibration.json", data)
    calibration = taken(partial(read_calibration, path), QuantizationError)
    if isinstance(calibration, QuantizationError):
        assert str(calibration).isprintable()
        return
    assert all(low <= 0 <= high and low < high for low, high in calibration.ranges.values())


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


def calibration_seeds() -> Iterator[bytes]:
    """The calibration of the shapes model, with few of its layers."""
    whole = read_calibration(_CALIBRATION)
    few = {name: dict(list(getattr(whole, name).items())[:_KEPT_LAYERS]) for name in ("ranges", "means")}
    path = _folder() / "seed.calibration.json"
    write_calibration(path, whole.model_copy(update=few))
    yield path.read_bytes()


def _check_boxes(boxes: Boxes, classes: int) -> None:
    assert np.isfinite(boxes.xyxy).all()
    assert (boxes.xyxy[:, :2] < boxes.xyxy[:, 2:]).all()
    assert all(0 <= class_id < classes for class_id in boxes.class_ids.tolist())


def _check_line(told: str) -> None:
    assert told.isprintable()


@cache
def _folder() -> Path:
    """A folder with an image file, removed at the end."""
    folder = Path(tempfile.mkdtemp())
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "1.jpg").touch()
    return folder


def _written(name: str, data: bytes) -> Path:
    path = _folder() / name
    path.write_bytes(data)
    return path
