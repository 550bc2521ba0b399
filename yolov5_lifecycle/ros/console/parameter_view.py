"""Conversion of parameters for the page, and of values from the page for ROS."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rclpy.parameter import Parameter, parameter_value_to_python

from yolov5_lifecycle.printable import in_one_line, printable
from yolov5_lifecycle.ros.parameters.declaration import TYPES
from yolov5_lifecycle.settings.schema import Setting
from yolov5_lifecycle.settings.settings import SCHEMA

_INTEGERS = range(-(2**63), 2**63)
_MAX_LENGTH = 1 << 20
"""Characters and entries of lists of all values of a detector that are shown."""


def parameters_as_json(values: Mapping[str, ParameterValue]) -> dict[str, dict[str, object]]:
    """The settings among parameters with their `values`, by name.

    A `value` of null is not set if `is_shown`; else it is of another type than the setting, not finite, or
    all that are shown would have more than _MAX_LENGTH.
    """
    found, length = dict[str, dict[str, object]](), 0
    for name, value in values.items():
        if setting := SCHEMA.find(name):
            plain = plain_value(value) if value.type == TYPES[setting.type].value else None
            total = length + _length(plain)
            is_shown = plain is not None or value.type == ParameterType.PARAMETER_NOT_SET
            if total > _MAX_LENGTH:
                plain, is_shown = None, False
            else:
                length = total
            found[name] = _as_json(setting) | {"value": plain, "is_shown": is_shown}
    return found


def _as_json(setting: Setting) -> dict[str, object]:
    has_range = setting.minimum is not None and setting.maximum is not None
    limits = {"from": setting.minimum, "to": setting.maximum, "step": setting.step or 0}
    return {
        "name": setting.name,
        "type": TYPES[setting.type].name.lower(),
        "default": setting.default,
        "description": setting.description,
        "constraints": setting.allowed,
        "range": limits if has_range else None,
        "choices": setting.choices or None,
        "change": setting.change.name.lower(),
    }


def plain_value(value: ParameterValue) -> object:
    """`value` for JSON, printable; None if it is not set or not finite."""
    plain: object = parameter_value_to_python(value)
    if isinstance(plain, float):
        return plain if math.isfinite(plain) else None
    if isinstance(plain, (list, tuple)):
        return list(map(printable, plain))
    return printable(plain) if isinstance(plain, str) else plain


def _length(plain: object) -> int:
    texts = plain if isinstance(plain, list) else [plain] if isinstance(plain, str) else []
    return len(texts) + sum(map(len, texts))


def parameter_message(name: str, value: Any) -> ParameterMessage:
    """The parameter `name` with `value` of JSON, which the node converts to its type; null deletes it.

    Raises ValueError for the user if no parameter can have this name or value.
    """
    if not _is_text(name):
        raise ValueError(f"{in_one_line(name, 100)}: expected the name of a parameter")
    if isinstance(value, list) and all(map(_is_text, value)):
        return Parameter(name, Parameter.Type.STRING_ARRAY, value).to_parameter_msg()
    is_number = isinstance(value, int) and value in _INTEGERS
    if not (value is None or is_number or isinstance(value, float) or _is_text(value)):
        shown = in_one_line(json.dumps(value), 100)
        expected = "true, false, a number of 64 bits, a string, or a list of strings"
        raise ValueError(f"{in_one_line(name, 100)}: expected {expected}, found {shown}")
    return Parameter(name, value=value).to_parameter_msg()


def _is_text(value: object) -> bool:
    """Whether `value` is a string that ROS can send: without NUL, which would end it, or half characters."""
    return isinstance(value, str) and not any(c == "\0" or "\ud800" <= c <= "\udfff" for c in value)
