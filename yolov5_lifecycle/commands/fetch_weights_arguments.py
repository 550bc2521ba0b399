"""Arguments of `fetch_weights`. They import no library that may be missing, so that `--help` always works."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.commands.official_weights import MODELS, URL
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings, validated

URL_VARIABLE = "YOLOV5_WEIGHTS_URL"
LICENCE = "The official YOLOv5 weights are by Ultralytics, under AGPL-3.0 or a licence bought from them.\n"


def command_parser() -> CommandParser:
    """The argument parser of the command."""
    parser = CommandParser("fetch_weights", description="Download an official YOLOv5 checkpoint. " + LICENCE)
    parser.add_argument(
        "model", nargs="?", choices=MODELS, metavar="MODEL", help=f"one of {', '.join(MODELS)}"
    )
    parser.add_argument("--list", action="store_true", help="list the weights files in the folder and exit")
    parser.add_argument(
        "--dir",
        type=Path,
        default=Path(Settings().weights_dir),
        help="folder for the file, like the detector's parameter weights_dir (default: %(default)s)",
    )
    parser.add_argument(
        "--sha256",
        type=_digest,
        default="",
        metavar="HEX",
        help="accept only a file with this digest (default: that of the official file, if known)",
    )
    parser.add_argument("--safetensors", action="store_true", help="convert the file to .safetensors as well")
    parser.add_argument(
        "--url",
        default=os.environ.get(URL_VARIABLE) or URL,
        help="address of a mirror, with {size} in it; or set the environment variable "
        f"{URL_VARIABLE} (default: %(default)s)",
    )
    return parser


def _digest(text: str) -> str:
    try:
        return validated({"weights_sha256": text}).weights_sha256
    except SettingsError as error:
        raise argparse.ArgumentTypeError(error.problems[0].message) from None
