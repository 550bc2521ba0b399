"""The command `evaluate` with the embedded model, and labelled data of the scene."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

from support.colcon_workspace import REPOSITORY
from support.detected_offline import prepare_once
from tools.shapes.dataset import write_dataset
from yolov5_lifecycle.offline.evaluate.command import main
from yolov5_lifecycle.sources.scene import CLASS_NAMES

WEIGHTS = str(REPOSITORY / "weights" / "shapes.safetensors")
FAST = ["--set", "image_size=320", "--set", "device=cpu", "--set", "runtime=onnxruntime"]

run = functools.partial(main, prepare=prepare_once)


def evaluate(data: Path, *words: str) -> int:
    """The exit code of `evaluate` for the embedded model."""
    return run([WEIGHTS, str(data), *FAST, *words])


def report_of(folder: Path) -> dict[str, Any]:
    report: dict[str, Any] = json.loads((folder / "report.json").read_text(), parse_constant=_no_number)
    return report


def _no_number(text: str) -> None:
    raise AssertionError(f"JSON has no {text}")


def shapes(folder: Path, images: int = 24) -> Path:
    """A new data set of shapes in YOLO format."""
    write_dataset(folder, images=images)
    return folder


def as_coco(data: Path) -> Path:
    """The data set of shapes `data` as a file in COCO format, written beside its images."""
    size_hw = (256, 320)
    images, annotations = [], []
    for number, label_file in enumerate(sorted((data / "labels" / "val").iterdir())):
        name = f"images/val/{label_file.stem}.jpg"
        images.append({"id": number, "file_name": name, "height": size_hw[0], "width": size_hw[1]})
        for line in label_file.read_text().splitlines():
            class_id, cx, cy, width, height = map(float, line.split())
            fractions = (cx - width / 2, cy - height / 2, width, height)
            bbox = [part * side for part, side in zip(fractions, size_hw[::-1] * 2, strict=True)]
            annotations.append({"image_id": number, "category_id": 10 + int(class_id), "bbox": bbox})
    categories = [{"id": 10 + number, "name": name} for number, name in enumerate(CLASS_NAMES)]
    path = data / "truth.json"
    path.write_text(json.dumps({"images": images, "annotations": annotations, "categories": categories}))
    return path
