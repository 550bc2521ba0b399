"""Command `convert IN.pt OUT.safetensors`: convert a checkpoint to a file of data only.

`convert --describe FILE` shows what a file contains.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import complain, write_output

if TYPE_CHECKING:  # torch is imported by the functions that need it: --help works without, and at once
    from yolov5_lifecycle.checkpoints.locate import WeightsFile

_MAX_PATH = 4096


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


def convert(source: Path, target: Path, *, overwrite: bool) -> WeightsFile:
    """Convert the model in `source` to `target` and return it as read back from `target`.

    Raises WeightsError, and OSError if `target` cannot be written.
    """
    from yolov5_lifecycle.checkpoints.locate import load_weights
    from yolov5_lifecycle.checkpoints.safetensors_file import write_safetensors
    from yolov5_lifecycle.models.model import WeightsError

    if target.suffix != ".safetensors":
        raise WeightsError(f"{target}: expected a name that ends in .safetensors.")
    if os.path.lexists(target) and not overwrite:
        raise WeightsError(f"{target} exists; give --force to replace it.")
    if not target.parent.is_dir():
        raise WeightsError(f"{target.parent}: folder not found; create it first.")
    write_safetensors(load_weights(source).model, target)
    return load_weights(target)


def report(written: WeightsFile) -> str:
    """Summary of the file for the user, one fact per line."""
    from yolov5_lifecycle.models.model import blueprint

    names = written.model.class_names
    parameters = sum(parameter.numel() for parameter in blueprint(written.model.architecture).parameters())
    return (
        f"{in_one_line(str(written.path), _MAX_PATH)}\n"
        f"classes     {len(names)}: {', '.join(names)}\n"
        f"parameters  {parameters:,}\n"
        f"sha256      {written.sha256}\n"
    )


def _describe(path: Path) -> int:
    from yolov5_lifecycle.checkpoints.description import description

    text, is_usable = description(path)
    return write_output("convert", text) or int(not is_usable)


def main(argv: Sequence[str] | None = None) -> int:
    parser = command_parser()
    arguments = parser.parse_args(argv)
    if arguments.describe is not None:
        if arguments.source is not None:
            parser.error("--describe takes a single file and writes none")
        return _describe(arguments.describe)
    if arguments.target is None:
        parser.error("the following arguments are required: IN.pt, OUT.safetensors")
    from yolov5_lifecycle.models.model import WeightsError

    try:
        written = convert(arguments.source, arguments.target, overwrite=arguments.force)
    except (WeightsError, OSError) as error:
        complain("convert", error)
        return 1
    return write_output("convert", report(written))
