"""The formats of exported detections: which suffix of an output stands for which."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

from yolov5_lifecycle.atomic_file import OutputError
from yolov5_lifecycle.offline.export.coco_json import CocoJson
from yolov5_lifecycle.offline.export.detected_image import NamedImage, Sink
from yolov5_lifecycle.offline.export.json_lines import JsonLines
from yolov5_lifecycle.offline.export.table import CsvTable, ParquetTable
from yolov5_lifecycle.offline.export.yolo_folder import YoloFolder, check_stems
from yolov5_lifecycle.process.missing_package import absence_of

JSON_LINES = ".jsonl"
"""The format of images and videos whose output has no suffix."""


class NewSink(Protocol):
    """Creates the output at a path, for detections of the classes, with masks if it can hold them."""

    def __call__(self, path: Path, class_names: Sequence[str], *, masks: bool) -> Sink: ...


@dataclass(frozen=True)
class Format:
    """A format of exported detections."""

    description: str
    new_sink: NewSink
    has_masks: bool
    has_ids: bool = True
    check_images: Callable[[Sequence[NamedImage]], None] | None = None
    """Raises OutputError for image files that it cannot tell apart."""
    package: str = ""
    """The package that writes it; "" if this one does."""


FORMATS: Mapping[str, Format] = MappingProxyType(
    {
        JSON_LINES: Format("JSON lines", JsonLines, has_masks=True),
        ".json": Format("COCO", CocoJson, has_masks=True),
        ".csv": Format("CSV", CsvTable, has_masks=False),
        ".parquet": Format("Parquet", ParquetTable, has_masks=False, package="pyarrow"),
        ".yolo": Format(
            "a folder of YOLO text", YoloFolder, has_masks=False, has_ids=False, check_images=check_stems
        ),
    }
)
"""By suffix of the output."""


def format_suffix(output: Path) -> str:
    """The key in FORMATS that the name of `output` ends in, whatever its case; "" if it ends in none."""
    suffix = output.suffix.lower()
    return suffix if suffix in FORMATS else ""


def may_have_masks(suffix: str) -> bool:
    """Whether the format `suffix` can hold masks; "" stands for a recording, which can."""
    return not suffix or FORMATS[suffix].has_masks


def check_format(suffix: str) -> None:
    """Raise OutputError if the package that writes the format `suffix` is missing."""
    package = FORMATS[suffix].package if suffix else ""
    if package and (absence := absence_of(package)):
        raise OutputError(f"{suffix} needs the package {package}: {absence}")


def check_export_name(output: Path) -> None:
    """Raise OutputError if the name of `output` promises a format that does not exist."""
    if output.suffix and not format_suffix(output):
        known = ", ".join(f"{suffix} ({one.description})" for suffix, one in FORMATS.items())
        raise OutputError(f"{output}: expected a name that ends in {known}, found {output.suffix}.")
