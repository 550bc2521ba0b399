"""Conversion of ROS parameters to values of settings, and back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.settings.schema import Setting

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
