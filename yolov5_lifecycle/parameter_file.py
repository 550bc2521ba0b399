"""Settings from where the node has its parameters: ROS parameter files and words of a command line."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import yaml

from yolov5_lifecycle.one_line import in_one_line
from yolov5_lifecycle.settings import SETTINGS_BY_NAME

QOS_PREFIX = "qos_overrides."
FOREIGN_PREFIXES = ("use_sim_time", QOS_PREFIX, "start_type_description_service")
"""Parameters that ROS declares on every node, when it pleases."""

_PARAMETERS = "ros__parameters"
# A date or number that cannot be one is a ValueError; so are bytes that are no text.
_UNREADABLE = (yaml.YAMLError, ValueError, RecursionError)


class ParameterFileError(ValueError):
    """A parameter file or an assignment that cannot be read; says which and what was expected."""


def file_values(path: Path, node: str) -> dict[str, object]:
    """What the parameter file at `path` says to the node with the full name `node`; later sections win.

    Names that are no setting are kept, except those of ROS itself. Raises ParameterFileError, also when the
    file speaks to other nodes only, and OSError.
    """
    sections = _read(path)
    meant = [values for pattern, values in sections if names_node(pattern, node)]
    if not meant:
        found = ", ".join(pattern for pattern, _ in sections) or "none"
        raise ParameterFileError(
            f"{path}: expected parameters ({_PARAMETERS}) of the node {node}, found of: {found}."
        )
    return {
        name: _coerced(name, value)
        for values in meant
        for name, value in values.items()
        if not name.startswith(FOREIGN_PREFIXES)
    }


def node_patterns(path: Path) -> list[str]:
    """The names of nodes, maybe with wildcards, that a parameter file speaks to.

    Raises ParameterFileError and OSError.
    """
    return [pattern for pattern, _ in _read(path)]


def names_node(pattern: str, node: str) -> bool:
    """Whether `pattern` is the full name `node`; * stands for one part of it, ** for any number."""
    wildcards = {"*": r"/[^/]+", "**": r"(/[^/]+)*"}
    parts = [wildcards.get(part, "/" + re.escape(part)) for part in pattern.strip("/").split("/")]
    return re.fullmatch("".join(parts), node) is not None


def assigned_value(assignment: str) -> tuple[str, object]:
    """Name and value of `name=value`, the value read as YAML; raises ParameterFileError."""
    name, equals, text = assignment.partition("=")
    if not (name and equals):
        raise ParameterFileError(f"{assignment!r}: expected NAME=VALUE, as in confidence_threshold=0.4.")
    try:
        return name, _coerced(name, yaml.safe_load(text) if text else "")
    except _UNREADABLE as error:
        raise ParameterFileError(f"{assignment!r}: its value is no YAML: {_in_a_line(error)}.") from None


def _coerced(name: str, value: object) -> object:
    """`value` in the type of the setting `name`, if there is one and the meaning is plain."""
    return SETTINGS_BY_NAME[name].coerced(value) if name in SETTINGS_BY_NAME else value


def _in_a_line(error: Exception) -> str:
    return in_one_line(str(error)).removesuffix(".")


def _read(path: Path) -> list[tuple[str, dict[str, object]]]:
    """Who is spoken to, and what is said: names with dots and values."""
    try:
        tree = yaml.safe_load(path.read_bytes())
        return [(pattern, dict(_flat(values))) for pattern, values in _sections(tree, "")]
    except _UNREADABLE as error:
        raise ParameterFileError(f"{path}: this is no YAML of parameters: {_in_a_line(error)}.") from None


def _sections(tree: object, prefix: str) -> Iterator[tuple[str, Mapping[object, object]]]:
    """Every group of parameters with the pattern of the names of its nodes; namespaces may be nested."""
    for key, value in tree.items() if isinstance(tree, dict) else ():
        if key == _PARAMETERS and (value is None or isinstance(value, dict)):
            yield prefix, value or {}
        else:
            yield from _sections(value, f"{prefix}/{str(key).strip('/')}")


def _flat(values: Mapping[object, object], prefix: str = "") -> Iterator[tuple[str, object]]:
    """Names with dots and values; a parameter file may nest what stands before a dot."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
