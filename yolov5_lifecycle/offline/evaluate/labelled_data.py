"""Labelled images for an evaluation: a YOLO folder or a COCO file."""

from __future__ import annotations

from pathlib import Path

from yolov5_lifecycle.evaluation.coco_file import read_coco_file
from yolov5_lifecycle.evaluation.ground_truth import DataError, LabelledFolder, Problems
from yolov5_lifecycle.evaluation.yolo_folder import YAML_SUFFIXES, read_yolo_folder
from yolov5_lifecycle.offline.evaluate.arguments import DataOptions
from yolov5_lifecycle.offline.recordings import is_recording


def kind_of(source: Path) -> str:
    """`YOLO` or `COCO`; raises DataError for anything else."""
    if source.suffix.lower() == ".json" and not source.is_dir():
        return "COCO"
    if source.suffix.lower() in YAML_SUFFIXES and not source.is_dir():
        return "YOLO"
    if is_recording(source):
        raise DataError(
            f"{source}: expected labelled images, found a recording: play it to a detector with "
            "`collect: true` and a `collect_dir`, correct the labels there, and name that folder."
        )
    if source.is_dir():
        return "YOLO"
    raise DataError(
        f"{source}: expected a folder with images/ and labels/, its data.yaml or a COCO file (.json)."
    )


def labelled_data(source: Path, options: DataOptions, problems: Problems) -> LabelledFolder:
    """The images and labels of `source`. Problems with single images are added to `problems`.

    Raises DataError if nothing can be used, and OSError.
    """
    if kind_of(source) == "COCO":
        return read_coco_file(source, problems, root=options.root)
    return read_yolo_folder(source, problems, split=options.split, root=options.root)
