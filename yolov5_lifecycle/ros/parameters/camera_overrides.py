"""Per-camera overrides of settings: declared only while they have a value, but always described."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

from rcl_interfaces.srv import DescribeParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.parameters.declaration import Declaration, declare_unset, unset_descriptor
from yolov5_lifecycle.ros.parameters.values import coerced, plain_values
from yolov5_lifecycle.settings.camera_names import MAX_CAMERAS
from yolov5_lifecycle.settings.schema import SEPARATOR, Problem
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS

MAX_OVERRIDES = MAX_CAMERAS * sum(setting.per_camera for setting in SETTINGS)
"""Of all cameras, those that are not in `cameras` included."""


def deletion(name: str) -> Parameter:
    """The request parameter that deletes `name`."""
    return Parameter(name, Parameter.Type.NOT_SET)


def problem_of(parameter: Parameter) -> Problem | None:
    """Why `parameter`, an override or a setting, is invalid whatever the others are, or None."""
    (value,) = plain_values([parameter], SCHEMA.found([parameter.name])).values()
    return SCHEMA.problem(parameter.name, value)


def declare_given(node: Node, declaration: Declaration) -> Declaration:
    """Declare the overrides that `node` was given, of any camera; `declaration` with them."""
    values, invalid, unknown = dict(declaration.values), dict(declaration.invalid), dict(declaration.unknown)
    for name in [*islice(SCHEMA.found(unknown), MAX_OVERRIDES)]:
        settings = SCHEMA.found([name])
        wanted = coerced(unknown.pop(name), settings, may_be_unset=True)
        if problem := problem_of(wanted):
            invalid[name] = problem
        else:
            declare_unset(node, settings[name])
            node.set_parameters([wanted])
            values |= plain_values([wanted], settings)
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


def without_camera(values: Mapping[str, object]) -> list[str]:
    """The overrides among `values` whose cameras are not in `values`."""
    return [name for name in values if SEPARATOR in name and not SCHEMA.is_known(name, values)]


def are_too_many(values: Mapping[str, object]) -> bool:
    """Whether there are more than MAX_OVERRIDES overrides in `values`; those that are None are deleted."""
    return sum(SEPARATOR in name and value is not None for name, value in values.items()) > MAX_OVERRIDES


def describe(
    node: Node, values: Mapping[str, object], request: DescribeParameters.Request, response: Any
) -> Any:
    """Response of the service `describe_parameters`, also for every override of a camera in `values`.

    As with rclpy, it is empty if a name is unknown.
    """
    described = []
    for name in request.names:
        if node.has_parameter(name):
            described.append(node.describe_parameter(name))
        elif SEPARATOR in name and SCHEMA.is_known(name, values):
            (setting,) = SCHEMA.found([name]).values()
            described.append(unset_descriptor(setting))
        else:
            return response
    response.descriptors = described
    return response
