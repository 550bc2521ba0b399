"""Arguments of `detect_bag`. They import no library that may be missing, so that `--help` always works."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.offline.detector_options import add_detector_options

TRACK = "tracker=bytetrack"
_MAX_JOBS = 1024
_EPILOG = """\
examples:
  detect_bag drive --output drive_detections --set weights=best.pt
  detect_bag drive.mcap --topic /front/image_raw --output front --images --params-file yolov5.yaml
  detect_bag drive --output drive_detections -p weights:=best.pt -p confidence_threshold:=0.4
  detect_bag holidays --annotated drawn --output holidays.jsonl
  detect_bag drive.mp4 --output drive.csv --crops
  detect_bag drives --output found --jobs 4 --set weights=best.pt

The suffix of --output selects the format: .jsonl (JSON lines), .json (COCO), .csv or .yolo (a folder of YOLO
text). Without one of these, a recording becomes a recording, and images and videos JSON lines.

With many recordings or videos (several paths, or a folder of them), PATH is a folder. It gets a folder for
each, and summary.json with the detection counts. Run again, the same command does only what is missing. If a
recording fails, the others go on; the exit code is then 3.
"""


def _job_count(text: str) -> int:
    count = int(text) if text.isdecimal() and len(text) <= len(str(_MAX_JOBS)) else 0
    if not 1 <= count <= _MAX_JOBS:
        raise argparse.ArgumentTypeError(
            f"expected a number of processes from 1 to {_MAX_JOBS}, found {text!r}"
        )
    return count


_ARGUMENTS: Mapping[str, Mapping[str, Any]] = {
    "sources": {
        "nargs": "+",
        "type": Path,
        "metavar": "SOURCE",
        "help": "a ros2 bag recording, a video, an image or a folder of images; or many recordings "
        "and videos",
    },
    "--output": {
        "type": Path,
        "metavar": "PATH",
        "help": "new output in the format of its suffix, see below (default for images and videos: JSON "
        "lines on stdout); for many recordings or videos, a folder",
    },
    "--jobs": {
        "type": _job_count,
        "metavar": "N",
        "help": "processes for many recordings (default: one per core, but at most one per GiB of free "
        "memory)",
    },
    "--topic": {"help": "image topic of the recording (default: the only one)"},
    "--images": {"action": "store_true", "help": "also write annotated images to the new recording"},
    "--annotated": {
        "type": Path,
        "metavar": "PATH",
        "help": "new annotated video, image or folder of images",
    },
    "--crops": {
        "action": "store_true",
        "help": "also write each detection as a JPEG file, to a new folder beside the output: PATH without "
        "suffix, with _crops; with many recordings or videos, into each result",
    },
    "--no-masks": {
        "action": "store_false",
        "dest": "masks",
        "help": "do not write the masks of a segmentation model; annotated images still show them",
    },
}


def command_parser() -> argparse.ArgumentParser:
    """The argument parser of the command."""
    parser = CommandParser(
        "detect_bag",
        description="Detect objects in every image of a recording, a video or a folder of images.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    for name, options in _ARGUMENTS.items():
        parser.add_argument(name, **options)
    add_detector_options(parser)
    parser.add_argument(
        "--track",
        action="append_const",
        dest="assignments",
        const=TRACK,
        help=f"give the same object the same id in every image; short for --set {TRACK}",
    )
    return parser
