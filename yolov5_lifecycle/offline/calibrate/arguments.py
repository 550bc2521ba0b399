"""Arguments of `calibrate`. They import no library that may be missing, so that `--help` always works."""

from __future__ import annotations

import argparse
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME

_EPILOG = """\
DATA is a folder of images, a video or a ros2 bag recording.

examples:
  calibrate best.pt drive.mcap
  calibrate best.pt images --image-size 320 --confidence-threshold 0.4

The file is written next to the weights, where the detector looks for it with precision int8. The command
prints whether int8 pays on this computer, and the line to type. See docs/int8.md.
"""


def command_parser() -> argparse.ArgumentParser:
    """The argument parser of the command."""
    parser = CommandParser(
        "calibrate",
        description="Measure on your images how well and how fast a model runs in int8 on this computer.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("weights", type=Path, metavar="WEIGHTS", help="weights, .pt or .safetensors")
    parser.add_argument(
        "data",
        type=Path,
        metavar="DATA",
        help="images like those that the camera will see; see below",
    )
    parser.add_argument("--topic", help="image topic of a recording (default: the only one)")
    parser.add_argument(
        "--image-size",
        type=int,
        default=SETTINGS_BY_NAME["image_size"].default,
        metavar="PIXELS",
        help="longer side of the network input, like the setting image_size (default: %(default)s)",
    )
    parser.add_argument(
        "--confidence-threshold",
        type=float,
        default=SETTINGS_BY_NAME["confidence_threshold"].default,
        metavar="SHARE",
        help="like the setting of the same name (default: %(default)s)",
    )
    return parser
