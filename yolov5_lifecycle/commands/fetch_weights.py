"""Command `fetch_weights MODEL`: download an official checkpoint to the folder the detector loads it from."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import TYPE_CHECKING

from yolov5_lifecycle.commands.command_line import CommandParser
from yolov5_lifecycle.commands.convert import convert, report
from yolov5_lifecycle.models.architecture import SIZES
from yolov5_lifecycle.printable import in_one_line, shell_command
from yolov5_lifecycle.process.standard_streams import complain, show_progress, write_output
from yolov5_lifecycle.settings.schema import SettingsError
from yolov5_lifecycle.settings.settings import Settings, validated

if TYPE_CHECKING:  # torch is imported by the functions that need it: --help works without, and at once
    from yolov5_lifecycle.checkpoints.locate import WeightsFile

MODELS = (*SIZES, *(f"{size}-seg" for size in SIZES if len(size) == 1))
"""The official models: for detection, then for segmentation."""
URL = "https://github.com/ultralytics/yolov5/releases/download/v7.0/yolov5{size}.pt"
SHA256: Mapping[str, str] = MappingProxyType(
    {
        "n": "4f180cf23ba0717ada0badd6c685026d73d48f184d00fc159c2641284b2ac0a3",
        "s": "8b3b748c1e592ddd8868022e8732fde20025197328490623cc16c6f24d0782ee",
        "m": "61d933360ba5a7733a36764996c800287d973889d875227f5beedd2473a97a56",
        "l": "2f603b7354c25454d1270663a14d8ddc1eea98e5eebc1d84ce0c6e3150fa155f",
        "x": "9f27a794fa0308e2606f90565164571d6f0a0ba18a3ce2e5e5d323b71c157859",
        "n6": "496c05a2b991da15acc6c4408c63da287f2513a46c6756618776d4dd71170781",
        "s6": "95bda9019ada63f37338308d0c81a66047a6fbaba061abaff271ba9334cf2a6f",
        "m6": "7afe7fa0f29a8351467200a2a5a33c7996d1155ed6636c7edd8ca70b14951c64",
        "l6": "b357b77f646b0190912985937c44e2923441369d5fda69ba86da2aa919212618",
        "x6": "257c991b216d625427dc4d9c7c76d6c6d93cf3732797538da34bdc02f97bfef0",
    }
)
"""Digests of the files of release v7.0 by model; those of the models for segmentation are not known."""
URL_VARIABLE = "YOLOV5_WEIGHTS_URL"
LICENCE = "The official YOLOv5 weights are by Ultralytics, under AGPL-3.0 or a licence bought from them.\n"


def command_parser() -> CommandParser:
    """The argument parser of the command."""
    parser = CommandParser("fetch_weights", description="Download an official YOLOv5 checkpoint. " + LICENCE)
    parser.add_argument("model", choices=MODELS, metavar="MODEL", help=f"one of {', '.join(MODELS)}")
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


def main(argv: Sequence[str] | None = None) -> int:
    arguments = command_parser().parse_args(argv)
    from yolov5_lifecycle.commands.download import DownloadError
    from yolov5_lifecycle.models.model import WeightsError

    try:
        summary = _run(arguments)
    except (DownloadError, WeightsError, OSError) as error:
        complain("fetch_weights", in_one_line(str(error)))
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("\n")  # ends the line of the progress bar
        complain("fetch_weights", "interrupted; run the command again to resume the download")
        return 130
    return write_output("fetch_weights", summary)


def _run(arguments: argparse.Namespace) -> str:
    """Run the command and return its output."""
    from yolov5_lifecycle.checkpoints.locate import expanded

    sys.stderr.write(LICENCE)
    found = _fetch_checked(arguments, expanded(arguments.dir))
    told = "" if arguments.sha256 else _official_line(arguments.model)
    if arguments.safetensors:
        found = _converted(found.path)
    return report(found) + told


def _converted(path: Path) -> WeightsFile:
    """The conversion of `path` beside it, as a former run may have left it; another file there is refused."""
    from yolov5_lifecycle.checkpoints.locate import weights_digest
    from yolov5_lifecycle.models.model import WeightsError

    target = path.with_suffix(".safetensors")
    if not os.path.lexists(target):
        return convert(path, target, overwrite=False)
    with TemporaryDirectory() as folder:
        found = convert(path, Path(folder) / target.name, overwrite=False)
    if weights_digest(target) != found.sha256:
        raise WeightsError(
            f"{target} exists, and holds another model than {path.name}: move it away, or replace it with "
            f"`{shell_command('convert', '--force', path, target)}`."
        )
    return replace(found, path=target)


def _fetch_checked(arguments: argparse.Namespace, folder: Path) -> WeightsFile:
    """The file with the digest that the user has given, or else that of the official file if it is known."""
    from yolov5_lifecycle.commands.download import fetch
    from yolov5_lifecycle.models.model import WeightsError

    model, official = arguments.model, SHA256.get(arguments.model, "")
    sha256 = arguments.sha256 or official
    try:
        return fetch(model, folder, url=arguments.url, sha256=sha256, progress=_show_bytes)
    except WeightsError as error:
        if arguments.sha256 or f"expected {official or None}" not in str(error):
            raise
        raise WeightsError(
            f"{error} The expected digest is that of yolov5{model}.pt in release v7.0: for another file that "
            "you trust, give its digest with --sha256."
        ) from None


def _official_line(model: str) -> str:
    if model in SHA256:
        return f"official    yes, by its sha256: yolov5{model}.pt of release v7.0\n"
    return f"official    not checked: the sha256 of yolov5{model}.pt is not known here; --sha256 checks it\n"


def _show_bytes(done_bytes: int, total_bytes: int | None) -> None:
    of_total = f" of {total_bytes / 1e6:.1f}" if total_bytes else ""
    show_progress(f"{done_bytes / 1e6:.1f}{of_total} MB", done=done_bytes == total_bytes)
