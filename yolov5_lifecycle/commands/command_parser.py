"""Argument parser shared by all commands other than the nodes."""

from __future__ import annotations

import argparse
import sys
from typing import Any, NoReturn

from yolov5_lifecycle.commands.version import version_line
from yolov5_lifecycle.process.standard_streams import complain

EXIT_USAGE = 2
"""Exit code for invalid arguments."""


class CommandParser(argparse.ArgumentParser):
    """ArgumentParser with `--version` that reports usage errors in one line."""

    def __init__(self, command: str, **options: Any) -> None:
        super().__init__(prog=command, **options)
        self.add_argument(
            "--version",
            action="version",
            version=version_line(command),
            help="print the version and end",
        )

    def error(self, message: str) -> NoReturn:
        complain(self.prog, f"{message}. `{self.prog} --help` explains all arguments.")
        sys.exit(EXIT_USAGE)
