"""Command-line arguments of a node; ROS gets the parameter files that can be read."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from yolov5_lifecycle.commands.command_line import EXIT_USAGE, version_line
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.process.standard_streams import complain, write_output
from yolov5_lifecycle.settings.parameter_file import (
    Nodes,
    ParameterFileError,
    Value,
    kind,
    names_node,
    parameter_value,
    read_parameter_file,
)
from yolov5_lifecycle.settings.schema import Setting
from yolov5_lifecycle.settings.value_text import shown_value, value_text

_FLAG = "--params-file"
_ASSIGNMENT_FLAGS = ("-p", "--param")
_MAX_NAMES = 5
_NO_LOG = re.compile(r"log(ging)? directory|\.log for writing")


@dataclass(frozen=True)
class StartArguments:
    """Command-line arguments of a node, without its unreadable parameter files.

    `files`: parameters in the readable ones, by path. `problems`: why the others cannot be read, and values
    that contradict each other.
    """

    words: tuple[str, ...]
    files: Mapping[str, Nodes]
    problems: tuple[str, ...]

    @property
    def own_words(self) -> list[str]:
        """The non-ROS arguments."""
        return list(remove_ros_args(list(self.words))[1:])


def start_arguments(arguments: Sequence[str]) -> StartArguments:
    """Read the parameter files in `arguments`; the first argument is the program.

    Raises RuntimeError for an argument that ROS cannot take.
    """
    for number, word in enumerate(arguments):
        _check_utf8(number, word)
    files: dict[str, Nodes] = {}
    problems: dict[str, str] = {}
    left_out = set[int]()
    for index, option, path in _ros_options(arguments):
        if option == _FLAG:
            try:
                files[path] = read_parameter_file(Path(path))
            except ParameterFileError as error:
                problems[path] = (
                    f"the parameter file cannot be read: {error} Correct the file and restart the node."
                )
                left_out |= {index, index + 1}
    words = tuple(word for index, word in enumerate(arguments) if index not in left_out)
    return StartArguments(words, files, (*problems.values(), *_clashes(words, files)))


def initialize(words: Sequence[str]) -> None:
    """Initialize rclpy without its signal handlers, which would shut the context down before nodes clean up.

    Raises RuntimeError for invalid ROS arguments, and without a folder for the log.
    """
    try:
        rclpy.init(args=list(words), signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        reason = in_one_line(str(error).partition(", at /")[0])  # without the lines of C where it arose
        if _NO_LOG.search(str(error)):
            reason += (
                ". Set ROS_LOG_DIR to a folder that this user can write to; without it, ROS logs to .ros/log "
                "in the folder HOME."
            )
        raise RuntimeError(reason) from error


def misaddressed_files(files: Mapping[str, Nodes], node_name: str) -> Iterator[str]:
    """One warning per file that has parameters for other nodes only, which ROS ignores silently.

    `files`: parameters by path. `node_name` is fully qualified.
    """
    for path, nodes in files.items():
        if nodes and not any(names_node(name, node_name) for name in nodes):
            others = ", ".join([*nodes][:_MAX_NAMES]) + (", ..." if len(nodes) > _MAX_NAMES else "")
            yield (
                f"the parameter file {path} has no effect: it is for {others}, but this node is "
                f"{node_name}. Use {node_name} or /** as its top-level key."
            )


def _clashes(words: Sequence[str], files: Mapping[str, Nodes]) -> Iterator[str]:
    """Problems of parameters given with two types for one node; rcl silently uses the wrong value.

    rcl prefers boolean over integer over double over string, regardless of the order: with `device: 0` in a
    file, `-p device:=cpu` is ignored. So are lists of strings after lists of integers, and empty lists after
    any other.
    """
    first: dict[tuple[str, str], tuple[Value, str]] = {}
    for node, name, value, place in _assignments(words, files):
        before, where = first.setdefault((node, name), (value, place))
        if before == [] and isinstance(value, list):
            first[node, name] = value, place
        elif kind(value) != kind(before):
            yield in_one_line(
                f"{name}: is given twice, as {shown_value(before)} in {where} and as {shown_value(value)} in "
                f"{place}; ROS picks one. Remove one, or give both the same type, and restart the node."
            )


def _assignments(words: Sequence[str], files: Mapping[str, Nodes]) -> Iterator[tuple[str, str, Value, str]]:
    """Node, name, value and source of each parameter in the ROS arguments."""
    for _, option, following in _ros_options(words):
        if option == _FLAG:
            for node, values in files[following].items():
                yield from ((node, name, value, following) for name, value in values.items())
        elif option in _ASSIGNMENT_FLAGS:
            left, _, text = following.partition(":=")
            node, _, name = left.rpartition(":")
            with suppress(ParameterFileError):  # ROS itself rejects it
                place = f"{option} {following}"
                yield f"/{node.removeprefix('/') or '**'}", name, parameter_value(text), place


def _check_utf8(number: int, word: str) -> None:
    try:
        word.encode()
    except UnicodeEncodeError:
        raise RuntimeError(
            f"argument {number}, {in_one_line(word)}: expected UTF-8, found other bytes. Rename what it "
            "names, or type it in a terminal that writes UTF-8."
        ) from None


def _ros_options(words: Sequence[str]) -> Iterator[tuple[int, str, str]]:
    """Position and value of the arguments from --ros-args to -- or the end, and the argument after each."""
    is_for_ros = False
    for index, (word, following) in enumerate(pairwise(words)):
        if word in ("--ros-args", "--"):
            is_for_ros = word == "--ros-args"
        elif is_for_ros:
            yield index, word, following


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
        f"  {setting.name:{width}}  {setting.description} Default: {value_text(setting.default)}"
        for setting in settings
    ]
    text = "\n".join([usage, *rows, f"`{command} --version` prints the version.", ""])
    return write_output(command, text)


def _unknown(command: str, words: Sequence[str], parameters: Sequence[str]) -> str:
    """One-line error for the unknown arguments `words`, with what to write instead."""
    names = [word.lstrip("-").partition("=")[0].replace("-", "_") for word in words]
    name = next((name for name in names if name in parameters), parameters[0])
    return (
        f"arguments not understood: {in_one_line(' '.join(words))}. Pass parameters as "
        f"`{command} --ros-args -p {name}:=VALUE`; `{command} --help` lists them."
    )
