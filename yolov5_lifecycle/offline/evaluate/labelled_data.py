"""Labelled images for an evaluation: a YOLO folder, a COCO file or a recording with corrected detections."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from yolov5_lifecycle.evaluation.coco_file import read_coco_file
from yolov5_lifecycle.evaluation.ground_truth import DataError, Labels, Problems, Progress, keep_silent
from yolov5_lifecycle.evaluation.yolo_folder import YAML_SUFFIXES, read_yolo_folder
from yolov5_lifecycle.offline.evaluate.arguments import DataOptions
from yolov5_lifecycle.offline.evaluate.evaluating import LabelledData
from yolov5_lifecycle.offline.image_files import ImageFile
from yolov5_lifecycle.offline.recordings import is_recording


@dataclass(frozen=True)
class _LabelledFile(ImageFile):
    number: int
    labels: Labels


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


def has_labels(source: Path) -> bool:
    """Whether `source` is a data set in YOLO or COCO format rather than images, a video or a recording."""
    if not source.is_dir():
        return source.suffix.lower() in (".json", *YAML_SUFFIXES)
    if is_recording(source):
        return False
    return (source / "data.yaml").is_file() or all((source / name).is_dir() for name in ("images", "labels"))


@contextmanager
def labelled_data(
    source: Path, options: DataOptions, problems: Problems, *, progress: Progress = keep_silent
) -> Iterator[LabelledData]:
    """Open the data set `source`. Problems with single images are added to `problems`.

    Raises DataError if nothing can be used, RecordingError, and ImportError without rosbags.
    """
    kind = kind_of(source)
    if kind == "recording":
        # rosbags is an extra.
        from yolov5_lifecycle.offline.evaluate.labelled_recording import labelled_recording

        with labelled_recording(source, options, problems, progress=progress) as data:
            yield data
        return
    if kind == "COCO":
        folder = read_coco_file(source, problems, root=options.root, progress=progress)
    else:
        folder = read_yolo_folder(source, problems, split=options.split, root=options.root, progress=progress)
    files = [_LabelledFile(image.path, number, image.labels) for number, image in enumerate(folder.images)]
    yield LabelledData(kind, folder.class_names, len(files), lambda: files)
