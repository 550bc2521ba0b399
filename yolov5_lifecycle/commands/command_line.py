"""What every command line has: the version of this package, and usage errors in one line."""

from __future__ import annotations

import argparse
import re
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NoReturn

from yolov5_lifecycle.process.standard_streams import complain

EXIT_USAGE = 2
"""Exit code for invalid arguments."""


def version_line(command: str) -> str:
    """Output of `command --version`, without the line break."""
    try:
        return f"{command} {version('yolov5_lifecycle')} (yolov5_lifecycle)"
    except PackageNotFoundError:
        return f"{command}, unknown version: yolov5_lifecycle is not installed"


def node_name(text: str) -> str:
    """Type of an argument: the full name of a node."""
    if not re.fullmatch(r"(/[A-Za-z_]\w*)+", text, re.ASCII):
        raise argparse.ArgumentTypeError(
            f"expected the full name of a node, such as /robot/yolov5, found {text!r}"
        )
    return text


class CommandParser(argparse.ArgumentParser):
    """Parser of the commands other than the nodes, with `--version` and usage errors in one line."""

    def __init__(self, prog: str, **options: Any) -> None:
        super().__init__(prog=prog, **options)
        self.add_argument(
            "--version",
            action="version",
            version=version_line(prog),
            help="print the version and exit",
        )

    def error(self, message: str) -> NoReturn:
        complain(self.prog, f"{message.rstrip('.')}. `{self.prog} --help` explains all arguments.")
        sys.exit(EXIT_USAGE)
