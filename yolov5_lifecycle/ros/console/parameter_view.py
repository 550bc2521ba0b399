"""Conversion of parameters for the page, and of values from the page for ROS."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor, ParameterType, ParameterValue
from rclpy.parameter import parameter_value_to_python

from yolov5_lifecycle.printable import in_one_line, printable
from yolov5_lifecycle.settings.schema import Change

_TYPES = {
    ParameterType.PARAMETER_BOOL: "bool",
    ParameterType.PARAMETER_INTEGER: "integer",
    ParameterType.PARAMETER_DOUBLE: "double",
    ParameterType.PARAMETER_STRING: "string",
    ParameterType.PARAMETER_STRING_ARRAY: "string_array",
}
_EXPECTED = {
    "bool": "true or false",
    "integer": "an integer",
    "double": "a number",
    "string": "a string",
    "string_array": "a list of strings",
}
_INTEGERS = range(-(2**63), 2**63)
_KINDS = "|".join(change.value.partition(":")[0] for change in Change)
_CONSTRAINTS = re.compile(
    rf"(?P<allowed>.*); default (?P<default>.*); (?P<change>{_KINDS}): "
    r".*?(?P<scope>; per camera)?",
    re.DOTALL,
)
"""The additional constraints of a descriptor, as `ros/parameters/declaration.py` writes them."""
_CHOICES = "one of "
_MAX_CONSTRAINTS = 5_000
_MAX_NAME = 200
_MAX_LENGTH = 1 << 20
"""Characters and entries of lists of all values of a detector that are shown."""


class ParameterView:
    """A declared parameter of a detector, from its descriptor; `constraints` are its additional ones."""

    def __init__(self, descriptor: ParameterDescriptor, constraints: re.Match[str]) -> None:
        self.name = str(descriptor.name)
        self.type = _TYPES.get(descriptor.type, "string")
        self.change = constraints["change"].replace("-", " ")
        self._json = {
            "name": self.name,
            "type": self.type,
            "default": self._of_own_type(_parsed(constraints["default"])),
            "description": in_one_line(descriptor.description),
            "constraints": in_one_line(constraints["allowed"]),
            "range": _range(descriptor),
            "choices": _choices(constraints["allowed"]) if self.type == "string" else None,
            "change": self.change,
            "per_camera": constraints["scope"] is not None,
            "read_only": bool(descriptor.read_only),
        }

    @classmethod
    def of(cls, descriptor: ParameterDescriptor) -> ParameterView | None:
        """The view of `descriptor`; None for a parameter that is not a setting, such as use_sim_time."""
        name, constraints = descriptor.name, descriptor.additional_constraints
        if len(constraints) > _MAX_CONSTRAINTS or len(name) > _MAX_NAME or not name.isprintable():
            return None
        found = _CONSTRAINTS.fullmatch(constraints)
        return cls(descriptor, found) if found else None

    def as_json(self, value: object, *, is_shown: bool = True) -> dict[str, object]:
        """The parameter with its current `value`, for JSON.

        null with `is_shown`: not set; without: its value is of another type or cannot be shown.
        """
        own = self._of_own_type(value)
        return self._json | {"value": own, "is_shown": is_shown and (own is not None or value is None)}

    def _of_own_type(self, value: object) -> object:
        return value if _is_of(value, self.type) else None


def _range(descriptor: ParameterDescriptor) -> dict[str, float] | None:
    for found in (*descriptor.floating_point_range, *descriptor.integer_range):
        return {"from": found.from_value, "to": found.to_value, "step": found.step}
    return None


def _choices(allowed: str) -> list[str] | None:
    is_list = allowed.startswith(_CHOICES)
    return printable(allowed).removeprefix(_CHOICES).split(", ") if is_list else None


def shown_values(values: Mapping[str, ParameterValue]) -> dict[str, object]:
    """`plain_value` of those of `values` that can be shown, in _MAX_LENGTH characters; None: not set."""
    shown, length = dict[str, object](), 0
    for name, value in values.items():
        plain = plain_value(value)
        texts = plain if isinstance(plain, list) else [plain] if isinstance(plain, str) else []
        total = length + len(texts) + sum(map(len, texts))
        is_known = plain is not None or value.type == ParameterType.PARAMETER_NOT_SET
        if is_known and total <= _MAX_LENGTH:
            shown[name], length = plain, total
    return shown


def plain_value(value: ParameterValue) -> object:
    """`value` for JSON, printable; None if it is not set, of a type that no setting has, or not finite."""
    plain: object = parameter_value_to_python(value) if value.type in _TYPES else None
    if isinstance(plain, float):
        return plain if math.isfinite(plain) else None
    if isinstance(plain, (list, tuple)):
        return list(map(printable, plain))
    return printable(plain) if isinstance(plain, str) else plain


def parameter_message(name: str, value: object, views: Mapping[str, ParameterView]) -> ParameterMessage:
    """The parameter `name` with `value` of JSON; null deletes it.

    Raises ValueError for the user if the value does not fit the type of the parameter.
    """
    if not _is_text(name):
        raise ValueError(f"{in_one_line(name, 100)}: expected the name of a parameter")
    view = views.get(name)
    type_name = view.type if view is not None else _type_of(value)
    if value is not None and not _is_of(value, type_name):
        shown = in_one_line(json.dumps(value), 100)
        raise ValueError(f"{in_one_line(name, 100)}: expected {_EXPECTED[type_name]}, found {shown}")
    return ParameterMessage(name=name, value=_message(value, type_name))


def _message(value: Any, type_name: str) -> ParameterValue:
    if value is None:
        return ParameterValue(type=ParameterType.PARAMETER_NOT_SET)
    (number,) = [number for number, name in _TYPES.items() if name == type_name]
    content = float(value) if type_name == "double" else value
    return ParameterValue(type=number, **{f"{type_name}_value": content})


def _type_of(value: object) -> str:
    """The type of a value for a parameter that is not declared, such as `front.max_rate`."""
    types = {bool: "bool", int: "integer", float: "double", str: "string"}
    return types.get(type(value), "string_array")


def _is_of(value: object, type_name: str) -> bool:
    if type_name == "bool":
        return isinstance(value, bool)
    if type_name == "string_array":
        return isinstance(value, list) and all(map(_is_text, value))
    if type_name == "string":
        return _is_text(value)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return isinstance(value, int) and value in _INTEGERS if type_name == "integer" else _is_double(value)


def _is_text(value: object) -> bool:
    """Whether `value` is a string that ROS can send: without NUL, which would end it, or half characters."""
    return isinstance(value, str) and not any(c == "\0" or "\ud800" <= c <= "\udfff" for c in value)


def _is_double(value: float) -> bool:
    try:
        return math.isfinite(float(value))
    except OverflowError:
        return False


def _parsed(default: str) -> object:
    try:
        return json.loads(default)
    except (ValueError, RecursionError):
        return None
