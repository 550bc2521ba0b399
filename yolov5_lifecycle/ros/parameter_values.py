"""Conversion between settings and ROS parameters: types, descriptors and coerced values."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, ParameterValue
from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.parameter import Parameter

from yolov5_lifecycle.settings.field import Change, Setting
from yolov5_lifecycle.settings.settings import SETTINGS_BY_NAME

MAX_ENTRIES = 10_000
"""Max entries of one list in a request; also the limit of the longest setting, `classes`."""

TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple: Parameter.Type.STRING_ARRAY,
}
_ARRAYS = [name for name in ParameterValue.get_fields_and_field_types() if name.endswith("_array_value")]


def read_parameters(messages: Iterable[ParameterMessage]) -> list[Parameter]:
    """Parameters of a request; raises ValueError for an unknown type or a list over MAX_ENTRIES."""
    return [_read(message) for message in messages]


def _read(message: ParameterMessage) -> Parameter:
    # rclpy iterates over every entry, which takes 60 ms for a million of them.
    if (longest := max(len(getattr(message.value, name)) for name in _ARRAYS)) > MAX_ENTRIES:
        raise ValueError(f"a parameter has a list of {longest} entries; at most {MAX_ENTRIES} are accepted.")
    return Parameter.from_parameter_msg(message)


def names_on_command_line(arguments: Sequence[str]) -> set[str]:
    """Names of parameters set with `-p [node:]name:=value` (or `--param`)."""
    assignments = [word for flag, word in pairwise(arguments) if flag in ("-p", "--param")]
    return {assignment.partition(":=")[0].rpartition(":")[2] for assignment in assignments}


def descriptor(setting: Setting) -> ParameterDescriptor:
    """Descriptor shown by `ros2 param describe`, with the range that rclpy enforces."""
    described = ParameterDescriptor(
        description=setting.description,
        additional_constraints=f"{setting.allowed}; {setting.change.value}",
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


def coerced(parameter: Parameter, *, may_be_unset: bool = False) -> Parameter:
    """Convert `parameter` to the type of its setting if unambiguous; otherwise return it unchanged.

    Follows `Setting.coerced`; in addition, an empty list may be of any type.
    """
    setting = SETTINGS_BY_NAME.get(parameter.name)
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


def plain_values(parameters: Iterable[Parameter]) -> dict[str, object]:
    """Values by name of the parameters that are settings."""
    return {
        parameter.name: tuple(parameter.value) if _is_list(parameter.value) else parameter.value
        for parameter in parameters
        if parameter.name in SETTINGS_BY_NAME
    }


def _is_list(value: object) -> bool:
    return hasattr(value, "__iter__") and not isinstance(value, (str, bytes))


def ros_value(default: object) -> object:
    return list(default) if isinstance(default, tuple) else default
