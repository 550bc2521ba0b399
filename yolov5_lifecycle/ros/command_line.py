"""Handling of a node's non-ROS arguments: --help, --version, and errors for all others."""

from __future__ import annotations

from collections.abc import Sequence

from yolov5_lifecycle.commands.command_line import EXIT_USAGE, version_line
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import complain, write_output
from yolov5_lifecycle.settings.schema import Setting

_HELP = {"-h", "--help"}
_VERSION = "--version"


def refuse(command: str, problem: object) -> int:
    """Print why `command` cannot start; return the exit code."""
    complain(command, problem)
    return EXIT_USAGE


def explain(command: str, words: Sequence[str], *, usage: str, settings: Sequence[Setting]) -> int:
    """Print help, version or an error; return the exit code."""
    unknown = [word for word in words if word not in _HELP and word != _VERSION]
    if unknown:
        return refuse(command, _unknown(command, unknown, [setting.name for setting in settings]))
    if _VERSION in words:
        return write_output(command, f"{version_line(command)}\n")
    width = max(len(setting.name) for setting in settings)
    rows = [
        f"  {setting.name:{width}}  {setting.description} Default: {setting.default!r}"
        for setting in settings
    ]
    text = "\n".join([usage, *rows, f"`{command} --version` prints the version.", ""])
    return write_output(command, text)


def _unknown(command: str, words: Sequence[str], parameters: Sequence[str]) -> str:
    """One-line error for the unknown arguments `words`, with what to write instead."""
    names = [word.lstrip("-").partition("=")[0].replace("-", "_") for word in words]
    name = next((name for name in names if name in parameters), parameters[0])
    return (
        f"arguments not understood: {in_one_line(' '.join(words))}. Parameters are given as "
        f"`{command} --ros-args -p {name}:=VALUE`; `{command} --help` lists them."
    )
