"""Settings from ROS parameter files and `name=value` command-line arguments.

rcl reads the parameters of a node. This module names the line of what rcl refuses or misunderstands, and
reads files for commands, which run without ROS.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from yolov5_lifecycle.input_file import read_regular_file
from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.settings import SCHEMA
from yolov5_lifecycle.settings.synonyms import ROS_PREFIXES
from yolov5_lifecycle.settings.value_text import shown_value, value_text

PARAMETERS = "ros__parameters"
"""The name below a node above its parameters."""
MAX_FILE_BYTES = 1 << 20

Value = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]
Nodes = dict[str, dict[str, Value]]
"""Parameter values by name, by the full name of the node, which may contain wildcards."""

_NODE_NAME = re.compile(r"(/(\*\*?|[A-Za-z_][A-Za-z0-9_]*))+")
_UNREADABLE = (yaml.YAMLError, ValueError, RecursionError, OSError)
_WILDCARDS = {"*": r"/\w+", "**": r"(/\w+)*"}


class ParameterFileError(ValueError):
    """A parameter file or assignment that cannot be read; names it and what was expected."""


class _Loader(yaml.SafeLoader):
    """Gives scalars the types that rcl gives them, which are neither those of YAML 1.1 nor of 1.2."""

    yaml_implicit_resolvers = {}  # noqa: RUF012
    bool_values = {**yaml.SafeLoader.bool_values, "y": True, "n": False}  # noqa: RUF012

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            alias = self.peek_event()  # type: ignore[no-untyped-call]
            raise _error(f"an alias (*{alias.anchor}): ROS reads none, write the value again", alias)
        return super().compose_node(parent, index)


for _type, _pattern in (
    ("bool", "(y|n|yes|no|on|off|true|false|Y|N|Yes|No|On|Off|True|False|YES|NO|ON|OFF|TRUE|FALSE)$"),
    ("int", "[+-]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)$"),
    ("float", r"[+-]?(([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|\.(inf|Inf|INF)|(?i:inf|infinity))$"),
    ("float", r"\.(nan|NaN|NAN)$|[+-]?(?i:nan)$"),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_type}", re.compile(_pattern), None)


def read_parameter_file(path: Path) -> Nodes:
    """The parameters in the file at `path`; nested names of nodes are joined with /, of parameters with dots.

    Raises ParameterFileError, whose message begins with the path.
    """
    try:
        nodes: Nodes = {}
        for document in yaml.compose_all(read_regular_file(path, MAX_FILE_BYTES), _Loader):
            for node, parameters in _sections(document):
                _add(nodes.setdefault(node, {}), parameters)
    except _UNREADABLE as error:
        raise ParameterFileError(f"{in_one_line(str(path))}: {_problem(error)}.") from None
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
    """Whether `pattern` matches the full name `node`; * matches one part of it, ** any number."""
    parts = (_WILDCARDS.get(part, f"/{re.escape(part)}") for part in pattern.strip("/").split("/"))
    return re.fullmatch("".join(parts), node) is not None


def assigned_value(assignment: str) -> tuple[str, object]:
    """Name and value of `name=value`, parsed as ROS parses `-p name:=value`; raises ParameterFileError."""
    name, equals, text = assignment.partition("=")
    if not (name and equals):
        raise ParameterFileError(f"{assignment!r}: expected NAME=VALUE, as in confidence_threshold=0.4.")
    try:
        return name, _coerced(name, parameter_value(text) if text else "")
    except ParameterFileError as error:
        raise ParameterFileError(f"{assignment!r}: its value is no YAML that ROS reads: {error}.") from None


def string_assignment(name: str, value: str) -> str:
    """The assignment that `assigned_value` reads as the string `value`, whatever characters it has."""
    return f"{name}={json.dumps(value, ensure_ascii=False)}"


def parameter_value(text: str) -> Value:
    """The value of `text`, parsed as in `-p name:=text`; raises ParameterFileError."""
    try:
        if (node := yaml.compose(text, _Loader)) is None:
            raise ParameterFileError("expected a value, found nothing")
        return _value(node)
    except _UNREADABLE as error:
        raise ParameterFileError(_problem(error)) from None


def kind(value: Value) -> tuple[type, type | None]:
    """The type of `value` and, if it is a list with entries, theirs; rcl treats each kind separately."""
    return type(value), type(value[0]) if isinstance(value, list) and value else None


def _coerced(name: str, value: object) -> object:
    """`value` converted by the setting `name`; unchanged if there is no such setting."""
    setting = SCHEMA.find(name)
    return value if setting is None else setting.coerced(value)


def _sections(mapping: yaml.Node, above: str = "") -> Iterator[tuple[str, yaml.Node]]:
    """The full name of every node below `mapping`, itself below `above`, and what has its parameters."""
    if not isinstance(mapping, yaml.MappingNode):
        raise _error("expected names of nodes, and below them ros__parameters", mapping)
    is_complete = False  # for rcl, ros__parameters ends the mapping of a node
    for key, value in mapping.value:
        name = _name(key)
        if is_complete:
            raise _error(_after_parameters(above.rstrip("/"), name), key)
        is_complete = name == PARAMETERS
        if is_complete:
            yield _node_name(above, key), value
        elif isinstance(value, yaml.MappingNode):
            yield from _sections(value, f"{above}{'/' if above and not above.endswith('/') else ''}{name}")
        else:
            raise _error(f"'{name}' has a value, but there is no {PARAMETERS}: above it", key)


def _node_name(name: str, key: yaml.Node) -> str:
    full_name = f"/{name.removeprefix('/')}"
    if not _NODE_NAME.fullmatch(full_name):
        raise _error(f"'{name}' above {PARAMETERS} is no name of a node", key)
    return full_name


def _after_parameters(node: str, name: str) -> str:
    """The problem of `name` below `node`, after its ros__parameters, and what to write."""
    if name == PARAMETERS:
        return f"a second {PARAMETERS} of '{node}', which ROS does not read: join it with the first"
    return (
        f"'{name}' follows the {PARAMETERS} of '{node}', where ROS reads no further node: move it to the "
        f"left margin, as '{node}/{name}:'"
    )


def _add(values: dict[str, Value], mapping: yaml.Node, above: str = "") -> None:
    """Add the parameters in `mapping` to `values`; `above` is what their names begin with."""
    if not isinstance(mapping, yaml.MappingNode):
        raise _error(f"expected names and values below {PARAMETERS}", mapping)
    for key, node in mapping.value:
        name = f"{above}{_name(key)}"
        if isinstance(node, yaml.MappingNode) and node.value:
            _add(values, node, f"{name}.")
            continue
        if isinstance(node, yaml.MappingNode):  # rcl takes the names that follow for names below this one
            raise _error(f"expected a value of '{name}', found {{}}: an empty list is []", key)
        _check_colon(mapping, node)
        value = _value(node)
        # If one name has values of two types, rcl uses the first of: boolean, integer, double, string.
        if name in values and kind(values[name]) != kind(value):
            raise _error(f"'{name}' has a value of another type further up: leave one out", key)
        values[name] = value


def _name(key: yaml.Node) -> str:
    if not isinstance(key, yaml.ScalarNode) or not key.value:
        raise _error("expected a name", key)
    return str(key.value)


def _value(node: yaml.Node) -> Value:
    """The value of a scalar or a list."""
    if not isinstance(node, yaml.SequenceNode):
        return _scalar(node)
    values = []
    for entry in node.value:
        _check_colon(node, entry)
        if not isinstance(entry, yaml.ScalarNode):
            quotes = ', write "NAME: VALUE" in quotes' if isinstance(entry, yaml.MappingNode) else ""
            raise _error(f"a list may hold values alone, no lists or mappings{quotes}", entry)
        values.append(_scalar(entry))
        if type(values[-1]) is not type(values[0]):
            raise _error(
                f"a list must hold values of one type, this one has {shown_value(values[0])} and "
                f"{shown_value(values[-1])}: write {_alike(values[0], values[-1])}",
                entry,
            )
    return values  # type: ignore[return-value] # all of one type


def _check_colon(parent: yaml.CollectionNode, node: yaml.Node) -> None:
    """Refuse what rcl's older libyaml does not read: text without quotes that has a colon, in [] or {}."""
    if parent.flow_style and isinstance(node, yaml.ScalarNode) and not node.style and ":" in node.value:
        raise _error(f"'{node.value}' has a colon within [] or {{}}: write it in quotes", node)


def _scalar(node: yaml.Node) -> bool | int | float | str:
    if not isinstance(node, yaml.ScalarNode):
        raise _error("expected a value", node)
    if not (node.value or node.style):
        raise _error("a name without a value", node)
    value: bool | int | float | str = _Loader("").construct_document(node)
    return value


def _alike(first: bool | int | float | str, other: bool | int | float | str) -> str:
    """A hint how to write two values of a list so that they have the same type."""
    if {type(first), type(other)} == {int, float}:
        return f"[{float(first)}, {float(other)}]"
    texts = (value if isinstance(value, str) else value_text(value) for value in (first, other))
    return json.dumps(list(texts), ensure_ascii=False)


def _error(problem: str, place: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=place.start_mark)


def _problem(error: Exception) -> str:
    """What is wrong, in one line, with the line of the file if it is known."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark:
        return f"line {error.problem_mark.line + 1}: {in_one_line(str(error.problem))}"
    return in_one_line(str(error)).removesuffix(".")
