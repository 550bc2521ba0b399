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
