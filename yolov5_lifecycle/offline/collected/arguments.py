"""Arguments of `collected`. They import no library that may be missing, so that `--help` always works."""

from __future__ import annotations

import argparse
from pathlib import Path

from yolov5_lifecycle.commands.command_line import CommandParser


def command_parser() -> argparse.ArgumentParser:
    """The argument parser of the command; every action has a `folder`."""
    parser = CommandParser("collected", description="Show and split what a detector has collected.")
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")

    def action(name: str, told: str) -> argparse.ArgumentParser:
        of_action = actions.add_parser(name, help=told)
        of_action.add_argument("folder", type=Path, metavar="FOLDER", help="the collect_dir of a detector")
        return of_action

    action("show", "how many images there are, and why they were kept")
    split = action("split", "write split.yaml: whole sessions for training or validation")
    split.add_argument(
        "--share",
        type=_share,
        default=0.2,
        metavar="SHARE",
        help="about this share of the images is for validation; default: %(default)s",
    )
    return parser


def _share(text: str) -> float:
    share = float(text)
    if not 0 < share < 1:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, found {text}")
    return share
