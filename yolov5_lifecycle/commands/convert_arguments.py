"""Arguments of `convert`. They import no library that may be missing, so that `--help` always works."""

from __future__ import annotations

from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser


def command_parser() -> CommandParser:
    """The argument parser of the command."""
    parser = CommandParser(
        "convert",
        description="Convert a YOLOv5 checkpoint to .safetensors, without running any of it.",
        usage="%(prog)s IN.pt OUT.safetensors [--force]\n       %(prog)s --describe FILE",
    )
    parser.add_argument("source", type=Path, metavar="IN.pt", nargs="?")
    parser.add_argument("target", type=Path, metavar="OUT.safetensors", nargs="?")
    parser.add_argument("--force", action="store_true", help="replace OUT.safetensors if it exists")
    parser.add_argument(
        "--describe",
        type=Path,
        metavar="FILE",
        help="show what a weights file contains and, if it is refused, why",
    )
    return parser
