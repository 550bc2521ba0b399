"""Settings from ROS parameter files and `name=value` command-line arguments."""

from __future__ import annotations

import json
import re
from pathlib import Path

from yolov5_lifecycle.input_file import RegularFileError, read_regular_file
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.parameter_yaml import (
    MAX_FILE_BYTES,
    PARAMETERS,
    Entry,
    ParameterYamlError,
    Value,
    parameter_entries,
    parameter_value,
)
from yolov5_lifecycle.settings.settings import SCHEMA
from yolov5_lifecycle.settings.synonyms import ROS_PREFIXES

MAX_DOUBLE_WILDCARDS = 3
"""`**` in a node name pattern; rclpy's matching time grows exponentially with their number."""

_NODE_NAME = re.compile(r"\*\*?|[A-Za-z_][A-Za-z0-9_]*")


class ParameterFileError(ValueError):
    """A parameter file or assignment that cannot be read; names it and what was expected."""


def read_parameter_file(path: Path) -> dict[str, dict[str, Value]]:
    """Parameter names and values in the file at `path`, by node name, which may contain wildcards.

    Node names are fully qualified (`/a/b`, `/**`), nested parameter names are joined with dots. Follows the
    rules and limits of `parameter_yaml`. Raises ParameterFileError, whose message begins with the path.
    """
    try:
        nodes: dict[str, dict[str, Value]] = {}
        for entry in parameter_entries(read_regular_file(path, MAX_FILE_BYTES)):
            _add(nodes, entry)
    except (ParameterYamlError, RegularFileError, OSError) as error:
        problem = error.strerror if isinstance(error, OSError) else str(error)
        raise ParameterFileError(f"{in_one_line(str(path))}: {problem}.") from None
    return nodes


def file_values(path: Path, node: str) -> dict[str, object]:
    """The parameters in the file at `path` for the node with the full name `node`; later sections win.

    Unknown names are kept, except ROS's own parameters. Raises ParameterFileError, also when the file only
    has parameters for other nodes.
    """
    nodes = read_parameter_file(path)
    meant = [values for pattern, values in nodes.items() if names_node(pattern, node)]
    if not meant:
        raise ParameterFileError(
            f"{path}: expected parameters ({PARAMETERS}) of the node {node}, found those of: "
            f"{', '.join(nodes) or 'none'}."
        )
    return {
        name: _coerced(name, value)
        for values in meant
        for name, value in values.items()
        if not name.startswith(ROS_PREFIXES)
    }


def names_node(pattern: str, node: str) -> bool:
    """Whether `pattern` matches the full name `node`; * matches one part of it, ** any number.

    Takes time proportional to the product of their lengths, however many wildcards there are.
    """
    parts, names = pattern.strip("/").split("/"), node.strip("/").split("/")
    at, retry, retried = 0, -1, 0
    index = 0
    while index < len(names):
        if at < len(parts) and parts[at] == "**":
            at, retry, retried = at + 1, at + 1, index
        elif at < len(parts) and parts[at] in ("*", names[index]):
            at, index = at + 1, index + 1
        elif retry >= 0:  # let the last ** match one more part
            retried += 1
            at, index = retry, retried
        else:
            return False
    return all(part == "**" for part in parts[at:])


def assigned_value(assignment: str) -> tuple[str, object]:
    """Name and value of `name=value`, parsed as ROS parses `-p name:=value`; raises ParameterFileError."""
    name, equals, text = assignment.partition("=")
    if not (name and equals):
        raise ParameterFileError(f"{assignment!r}: expected NAME=VALUE, as in confidence_threshold=0.4.")
    try:
        return name, _coerced(name, parameter_value(text) if text else "")
    except ParameterYamlError as error:
        raise ParameterFileError(f"{assignment!r}: its value is no YAML that ROS reads: {error}.") from None


def string_assignment(name: str, value: str) -> str:
    """The assignment that `assigned_value` reads as the string `value`, whatever characters it has."""
    return f"{name}={json.dumps(value, ensure_ascii=False)}"


def _coerced(name: str, value: object) -> object:
    """`value` converted by the setting `name`; unchanged if there is no such setting."""
    setting = SCHEMA.find(name)
    return value if setting is None else setting.coerced(value)


def _add(nodes: dict[str, dict[str, Value]], entry: Entry) -> None:
    """Add `entry` to `nodes`; raises ParameterYamlError."""
    if PARAMETERS not in entry.names:
        if entry.value is None:
            return
        raise ParameterYamlError(
            f"line {entry.line}: '{in_one_line(entry.names[-1])}' has a value, but there is no "
            f"{PARAMETERS}: above it"
        )
    depth = entry.names.index(PARAMETERS)
    values = nodes.setdefault(_node_pattern(entry, depth), {})
    name, value = ".".join(entry.names[depth + 1 :]), entry.value
    if not name and value is None:
        return
    if not name:
        raise ParameterYamlError(f"line {entry.line}: expected names and values below {PARAMETERS}")
    if value is None:  # rcl takes the names that follow for names below this one
        raise ParameterYamlError(
            f"line {entry.line}: expected a value of '{in_one_line(name)}', found {{}}: an empty list is []"
        )
    # If one name has values of two types, rcl uses the first of: boolean, integer, double, string.
    if name in values and kind(values[name]) != kind(value):
        raise ParameterYamlError(
            f"line {entry.line}: '{in_one_line(name)}' has a value of another type further up: leave one out"
        )
    values[name] = value


def _node_pattern(entry: Entry, depth: int) -> str:
    """The first `depth` names of `entry`, joined into a node name."""
    name = ""
    for part in entry.names[:depth]:
        name += part if not name or name.endswith("/") else f"/{part}"
    pattern = f"/{name.removeprefix('/')}"
    parts = pattern[1:].split("/")
    if not all(_NODE_NAME.fullmatch(part) for part in parts):
        raise ParameterYamlError(
            f"line {entry.line}: '{in_one_line(name)}' above {PARAMETERS} is no name of a node"
        )
    if parts.count("**") > MAX_DOUBLE_WILDCARDS:
        raise ParameterYamlError(
            f"line {entry.line}: more than {MAX_DOUBLE_WILDCARDS} '**' in the name of a node: one is enough"
        )
    return pattern


def kind(value: Value) -> tuple[type, type | None]:
    """The type of `value` and, if it is a list with entries, theirs; rcl treats each kind separately."""
    return type(value), type(value[0]) if isinstance(value, list) and value else None
