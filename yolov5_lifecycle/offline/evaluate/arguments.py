"""Arguments of `evaluate`. They import no library that may be missing, so that `--help` always works."""

from __future__ import annotations

import argparse
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.evaluation.ground_truth import SPLITS
from yolov5_lifecycle.evaluation.thresholds import Goal
from yolov5_lifecycle.offline.detector_options import add_detector_options

_EPILOG = """\
DATA is one of
  a folder with images/ and labels/ in YOLO format, or its data.yaml
  a COCO file (.json) next to its images

examples:
  evaluate best.pt shots
  evaluate best.pt shots/data.yaml --split test --output report
  evaluate best.pt instances_val.json --root images --thresholds f1
  evaluate best.pt shots --compare older.pt
  evaluate best.pt shots --compare runtime=openvino,image_size=320
"""


def command_parser() -> argparse.ArgumentParser:
    """The argument parser of the command."""
    parser = CommandParser(
        "evaluate",
        description="Measure how good a model is on labelled images: precision, recall, F1 and mAP of each\n"
        "class, the confusion matrix, and the time per image.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("weights", metavar="WEIGHTS", help="weights file (.pt, .safetensors or .onnx)")
    parser.add_argument("data", type=Path, metavar="DATA", help="labelled images, see below")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FOLDER",
        help="new folder for report.json and all detections",
    )
    parser.add_argument(
        "--compare",
        metavar="OTHER",
        help="another weights file, or other parameters as NAME=VALUE[,NAME=VALUE], to compare with; prints "
        "95 %% intervals of the differences",
    )
    parser.add_argument(
        "--thresholds",
        type=Goal.parsed,
        metavar="GOAL",
        help="f1, recall=0.9 or precision=0.95: print thresholds that reach it, as detector parameters",
    )
    parser.add_argument(
        "--split",
        choices=SPLITS,
        help=f"images of data.yaml to use (default: the first of {', '.join(SPLITS)})",
    )
    parser.add_argument(
        "--root",
        type=Path,
        metavar="FOLDER",
        help="folder of the labelled images; nothing outside it is read (default: that of data.yaml or JSON)",
    )
    add_detector_options(parser)
    return parser
