"""Parameters of a node and values of its settings: conversion, declaration, descriptors, sources.

Overrides of settings for a camera are declared only while they have a value, but always described.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.rclpy_internals import parameter_overrides
from yolov5_lifecycle.settings.schema import Change, Problem, Schema, Setting
from yolov5_lifecycle.settings.settings import SCHEMA
from yolov5_lifecycle.settings.synonyms import ROS_PREFIXES
from yolov5_lifecycle.settings.value_text import value_text

TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple: Parameter.Type.STRING_ARRAY,
}


def coerced(
    parameter: Parameter, settings: Mapping[str, Setting], *, may_be_unset: bool = False
) -> Parameter:
    """Convert `parameter` to the type of its setting if unambiguous; otherwise return it unchanged.

    Follows `Setting.coerced`; in addition, an empty list may be of any type. `settings` by name.
    """
    setting = settings.get(parameter.name)
    if setting is None:
        return parameter
    if setting.type is tuple and _is_empty(parameter, may_be_unset):
        return Parameter(parameter.name, TYPES[tuple], [])
    value = list(parameter.value) if _is_list(parameter.value) else parameter.value
    meant = setting.coerced(value)
    return parameter if meant is value else Parameter(parameter.name, TYPES[setting.type], meant)


def _is_empty(parameter: Parameter, may_be_unset: bool) -> bool:
    if parameter.type_ is Parameter.Type.NOT_SET:
        return may_be_unset  # YAML `[]`; from a service it means "delete"
    return parameter.type_.name.endswith("ARRAY") and len(parameter.value) == 0


def stays(node: Node, parameter: Parameter) -> bool:
    """Whether `parameter` deletes an override that is not set, or is read-only and has this value.

    rclpy would reject both, the latter with `ros2 param load` of a dump of the node.
    """
    name = parameter.name
    if not node.has_parameter(name):
        return parameter.type_ is Parameter.Type.NOT_SET
    if not node.describe_parameter(name).read_only:
        return False
    present = node.get_parameter(name)
    return (parameter.type_, parameter.value) == (present.type_, present.value)


def plain_values(parameters: Iterable[Parameter], settings: Mapping[str, Setting]) -> dict[str, object]:
    """Values by name of the parameters that are among `settings`."""
    return {
        parameter.name: tuple(parameter.value) if _is_list(parameter.value) else parameter.value
        for parameter in parameters
        if parameter.name in settings
    }


def _is_list(value: object) -> bool:
    return hasattr(value, "__iter__") and not isinstance(value, (str, bytes))


def ros_value(value: object) -> object:
    """`value` of a setting in the form that rclpy accepts."""
    return list(value) if isinstance(value, tuple) else value


class Source(Enum):
    """Source of a setting's value."""

    DEFAULT = "default"
    PARAMETER_FILE = "parameter file"
    COMMAND_LINE = "command line"
    RUN_TIME = "set at run time"


@dataclass(frozen=True)
class Declaration:
    """What a node started with: values by name, and the given parameters that it cannot use.

    A setting whose given value is `invalid` has its `fallback`; a setting of a camera has the value of the
    node. `unknown`: what is not a setting. `sources`: also those of unusable ones. All by name.
    """

    values: Mapping[str, object]
    sources: Mapping[str, Source]
    invalid: Mapping[str, Problem]
    unknown: Mapping[str, Parameter]


def declare(node: Node, schema: Schema[Any], *, arguments: Sequence[str] = ()) -> Declaration:
    """Declare a parameter for every setting of `schema`; never raises for a bad override.

    `arguments` are the command-line arguments, to find the source of an override.
    """
    overrides = parameter_overrides(node)
    on_command_line = _names_on_command_line(arguments)
    sources, invalid = dict[str, Source](), dict[str, Problem]()
    for setting in schema.settings:
        override = overrides.pop(setting.name, None)
        sources[setting.name] = _source(override, on_command_line)
        parameter = Parameter(setting.name, TYPES[setting.type], ros_value(setting.default))
        if override is not None:
            parameter = coerced(override, schema.by_name, may_be_unset=True)
            (value,) = plain_values([parameter], schema.by_name).values()
            if problem := schema.problem(setting.name, value):
                invalid[setting.name] = problem
                usable = schema.fallback(setting.name, value)
                parameter = Parameter(setting.name, TYPES[setting.type], ros_value(usable))
        _declare(node, setting, parameter)
    values = plain_values(map(node.get_parameter, schema.by_name), schema.by_name)
    unknown = {name: given for name, given in overrides.items() if not name.startswith(ROS_PREFIXES)}
    sources |= {name: _source(given, on_command_line) for name, given in unknown.items()}
    return Declaration(values, sources, invalid, unknown)


def source_table(values: Mapping[str, object], sources: Mapping[str, Source]) -> str:
    """Name, value and source of every setting in `sources`, one per line."""
    width = max(map(len, sources))
    return "\n".join(
        f"  {name:{width}}  {value_text(values[name]):<28}  {source.value}"
        for name, source in sources.items()
    )


def _source(override: Parameter | None, on_command_line: set[str]) -> Source:
    if override is None:
        return Source.DEFAULT
    return Source.COMMAND_LINE if override.name in on_command_line else Source.PARAMETER_FILE


def _names_on_command_line(arguments: Sequence[str]) -> set[str]:
    """Names of parameters set with `-p [node:]name:=value` (or `--param`)."""
    assignments = [word for flag, word in pairwise(arguments) if flag in ("-p", "--param")]
    return {assignment.partition(":=")[0].rpartition(":")[2] for assignment in assignments}


def _declare(node: Node, setting: Setting, parameter: Parameter) -> None:
    described = descriptor(setting)
    if parameter.value != []:
        node.declare_parameter(setting.name, parameter.value, described, ignore_override=True)
        return
    # An empty list must be declared by type and then set: rclpy would infer BYTE_ARRAY (ros2/rclpy#912).
    # It may become read-only only after that.
    node.declare_parameter(setting.name, parameter.type_, ignore_override=True)
    node.set_parameters([parameter])
    described.type = parameter.type_.value
    node.set_descriptor(setting.name, described)


def declare_unset(node: Node, setting: Setting) -> None:
    """Declare a parameter that has no value yet and may be deleted: the override of a setting for a camera.

    In rclpy, only parameters of dynamic type may have no value.
    """
    node.declare_parameter(setting.name, None, unset_descriptor(setting), ignore_override=True)


def unset_descriptor(setting: Setting) -> ParameterDescriptor:
    """Descriptor of a parameter that may have no value."""
    described = descriptor(setting)
    described.name, described.type, described.dynamic_typing = setting.name, TYPES[setting.type].value, True
    return described


def descriptor(setting: Setting) -> ParameterDescriptor:
    """Descriptor shown by `ros2 param describe`, with the range that rclpy enforces.

    The console reads the constraints (`ros/console/parameter_view.py`).
    """
    effect = f"{setting.change.value}{'; per camera' if setting.per_camera else ''}"
    default = json.dumps(ros_value(setting.default), ensure_ascii=False)
    described = ParameterDescriptor(
        description=setting.description,
        additional_constraints=f"{setting.allowed}; default {default}; {effect}",
        read_only=setting.change is Change.READ_ONLY,
    )
    if setting.minimum is None or setting.maximum is None:
        return described
    if setting.type is int:
        described.integer_range = [
            IntegerRange(
                from_value=int(setting.minimum), to_value=int(setting.maximum), step=int(setting.step or 1)
            )
        ]
    else:
        described.floating_point_range = [
            FloatingPointRange(from_value=float(setting.minimum), to_value=float(setting.maximum))
        ]
    return described


def deletion(name: str) -> Parameter:
    """The request parameter that deletes `name`."""
    return Parameter(name, Parameter.Type.NOT_SET)


def declare_given(node: Node, declaration: Declaration) -> Declaration:
    """Declare the overrides that `node` was given, of any camera; `declaration` with them."""
    values, invalid, unknown = dict(declaration.values), dict(declaration.invalid), dict(declaration.unknown)
    for name in SCHEMA.found(unknown):
        settings = SCHEMA.found([name])
        wanted = coerced(unknown.pop(name), settings, may_be_unset=True)
        given = plain_values([wanted], settings)
        if problem := SCHEMA.problem(name, given[name]):
            invalid[name] = problem
        else:
            declare_unset(node, settings[name])
            node.set_parameters([wanted])
            values |= given
    return replace(declaration, values=values, invalid=invalid, unknown=unknown)


def declare_missing(node: Node, parameters: Iterable[Parameter]) -> None:
    """Declare those overrides among `parameters` that are about to get their first value."""
    names = [
        parameter.name
        for parameter in parameters
        if parameter.type_ is not Parameter.Type.NOT_SET and not node.has_parameter(parameter.name)
    ]
    for setting in SCHEMA.found(names).values():
        declare_unset(node, setting)


def undeclare_unset(node: Node, parameters: Iterable[Parameter]) -> None:
    """Undeclare the overrides among `parameters` that were declared, but did not get a value."""
    for setting in SCHEMA.found(parameter.name for parameter in parameters).values():
        unset = deletion(setting.name)
        if node.has_parameter(setting.name) and node.get_parameter_or(setting.name, unset) is unset:
            node.undeclare_parameter(setting.name)
