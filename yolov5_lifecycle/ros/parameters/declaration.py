"""Parameters of a node and values of its settings: conversion, declaration, descriptors.

Overrides of settings for a camera are declared only while they have a value.
"""

from __future__ import annotations

import json
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.rclpy_internals import parameter_overrides
from yolov5_lifecycle.settings.schema import Change, Schema, Setting
from yolov5_lifecycle.settings.synonyms import ROS_PREFIXES

TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple: Parameter.Type.STRING_ARRAY,
}


def value_of(parameter: Parameter, setting: Setting | None) -> object:
    """Value of `parameter` in the type of its `setting` if that is unambiguous, see `Setting.coerced`.

    A list is a tuple, an empty one may be of any type. None without a value.
    """
    value = parameter.value
    meant = tuple(value) if parameter.type_.name.endswith("ARRAY") else value
    coerced = meant if setting is None else setting.coerced(meant)
    return tuple(coerced) if isinstance(coerced, list) else coerced


def parameter_of(setting: Setting, value: object) -> Parameter:
    """The parameter that sets `setting` to a valid `value`, or deletes it if that is None."""
    if value is None:
        return Parameter(setting.name, Parameter.Type.NOT_SET)
    return Parameter(setting.name, TYPES[setting.type], list(value) if isinstance(value, tuple) else value)


def declare(node: Node, schema: Schema[Any]) -> dict[str, object]:
    """Declare a parameter for every setting of `schema`; values of the settings and all else that was given.

    Never raises for a bad value: it is among the values, but the parameter has the default. Overrides for a
    camera are declared if they are valid.
    """
    given: dict[str, object] = {}
    for name, parameter in parameter_overrides(node).items():
        if not name.startswith(ROS_PREFIXES):
            setting = schema.find(name)
            value = value_of(parameter, setting)
            # rcl reads an empty list as a parameter without a value.
            given[name] = () if value is None and setting is not None and setting.type is tuple else value
    values = {setting.name: setting.default for setting in schema.settings} | given
    for name, value in values.items():
        if (setting := schema.find(name)) is None:
            continue
        is_valid = name not in given or schema.problem(name, value) is None
        if name in schema.by_name:
            _declare(node, setting, parameter_of(setting, value if is_valid else setting.default))
        elif is_valid:
            declare_unset(node, setting)
            node.set_parameters([parameter_of(setting, value)])
    return values


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
    described = descriptor(setting)
    described.dynamic_typing = True
    node.declare_parameter(setting.name, None, described, ignore_override=True)


def descriptor(setting: Setting) -> ParameterDescriptor:
    """Descriptor shown by `ros2 param describe`, with the range that rclpy enforces."""
    effect = f"{setting.change.value}{'; per camera' if setting.per_camera else ''}"
    default = json.dumps(setting.default, ensure_ascii=False)
    described = ParameterDescriptor(
        description=setting.description,
        additional_constraints=f"{setting.allowed}; default {default}; {effect}",
        read_only=setting.change is Change.READ_ONLY,
    )
    if setting.minimum is None or setting.maximum is None:
        return described
    if setting.type is int:
        step = int(setting.step or 1)
        limits = IntegerRange(from_value=int(setting.minimum), to_value=int(setting.maximum), step=step)
        described.integer_range = [limits]
    else:
        described.floating_point_range = [
            FloatingPointRange(from_value=float(setting.minimum), to_value=float(setting.maximum))
        ]
    return described
