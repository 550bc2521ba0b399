"""The node's ROS parameters, derived from Settings: declared, coerced and judged."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from itertools import pairwise

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.parameter_file import FOREIGN_PREFIXES
from yolov5_lifecycle.ros.qos_overrides import parameter_overrides, qos_contradictions, qos_problems
from yolov5_lifecycle.setting import Change, Setting
from yolov5_lifecycle.settings import (
    SETTINGS,
    SETTINGS_BY_NAME,
    Problem,
    Settings,
    SettingsError,
    meant_setting,
    unknown_setting,
    validated,
)

Review = Callable[[Settings], list[Problem]]
Commit = Callable[[Settings], None]

_TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
    tuple: Parameter.Type.STRING_ARRAY,
}


class Source(Enum):
    """Where the value of a setting comes from."""

    DEFAULT = "default"
    PARAMETER_FILE = "parameter file"
    COMMAND_LINE = "command line"
    RUN_TIME = "set at run time"


class SettingsParameters:
    """Owns the declaration of every setting and the callbacks that judge and commit a change.

    A bad override (YAML file or command line) never raises: the parameter is declared with its default and
    the problem is kept until the parameter is set again, so that configure can name all of them.

    `review(candidate)` adds the rules that need the loaded model; `commit(settings)` is told after every
    change that leaves a valid whole. `arguments` are the words of the command line, to tell where an override
    comes from.
    """

    def __init__(self, node: Node, *, review: Review, commit: Commit, arguments: Sequence[str] = ()) -> None:
        self._node = node
        self._review = review
        self._commit = commit
        self._bad_overrides: dict[str, Problem] = {}
        self._sources = dict.fromkeys(SETTINGS_BY_NAME, Source.DEFAULT)
        overrides = parameter_overrides(node)
        for setting in SETTINGS:
            if (override := overrides.pop(setting.name, None)) is not None:
                on_command_line = setting.name in names_on_command_line(arguments)
                self._sources[setting.name] = (
                    Source.COMMAND_LINE if on_command_line else Source.PARAMETER_FILE
                )
            self._declare(setting, override)
        for name in overrides:
            if not name.startswith(FOREIGN_PREFIXES):
                self._bad_overrides[name] = _unknown_override(name, node.get_fully_qualified_name())
        node.add_pre_set_parameters_callback(
            lambda parameters: [coerced(parameter) for parameter in parameters]
        )
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._committed)

    def problems(self) -> list[Problem]:
        """What is wrong with the current values and the overrides that gave them."""
        return [
            *self._bad_overrides.values(),
            *qos_problems(self._node),
            *self._problems(self._values()),
        ]

    def settings(self) -> Settings:
        """The current values; raises SettingsError when they contradict each other."""
        return validated(self._values())

    def candidate(self, parameters: Iterable[Parameter]) -> Settings:
        """What the settings would be with `parameters` set; raises SettingsError. Changes nothing."""
        return validated(self._values() | plain_values(map(coerced, parameters)))

    def changes(self, parameters: Iterable[Parameter]) -> list[Parameter]:
        """`parameters` without those that are read-only and asked to be what they are.

        rclpy would refuse them, and with them the dump of a node that is loaded back.
        """
        return [parameter for parameter in parameters if not self._stays(coerced(parameter))]

    def problems_of(self, parameters: Sequence[Parameter]) -> list[Problem]:
        """Why a request to set `parameters` must be refused, as far as that can be said without the model."""
        unknown = [unknown_setting(name) for name in self._unknown_names(parameters)]
        return unknown + self._new_problems(parameters)

    def table(self) -> str:
        """Name, value and source of every setting, one a line."""
        width = max(map(len, SETTINGS_BY_NAME))
        values = self._values()
        return "\n".join(
            f"  {name:{width}}  {_ros_value(values[name])!r:<28}  {source.value}"
            for name, source in self._sources.items()
        )

    def is_taken_back(self, parameter: Parameter) -> bool:
        """Whether `parameter` deletes an override with an unknown name."""
        return (
            parameter.type_ is Parameter.Type.NOT_SET
            and parameter.name in self._bad_overrides.keys() - SETTINGS_BY_NAME.keys()
        )

    def forget(self, taken_back: Iterable[Parameter]) -> None:
        """Drop the complaints about overrides that were taken back."""
        for parameter in taken_back:
            self._bad_overrides.pop(parameter.name, None)

    def _problems(self, values: dict[str, object]) -> list[Problem]:
        try:
            settings = validated(values)
        except SettingsError as error:
            return error.problems
        return qos_contradictions(self._node, settings)

    def _stays(self, parameter: Parameter) -> bool:
        name = parameter.name
        if not self._node.has_parameter(name) or not self._node.describe_parameter(name).read_only:
            return False
        present = self._node.get_parameter(name)
        return (parameter.type_, parameter.value) == (present.type_, present.value)

    def _new_problems(self, parameters: Iterable[Parameter]) -> list[Problem]:
        """What `parameters` would break that is not broken already; an older problem may stay."""
        values = self._values()
        known = self._problems(values)
        broken = self._problems(values | plain_values(map(coerced, parameters)))
        return [problem for problem in broken if problem not in known]

    def _unknown_names(self, parameters: Iterable[Parameter]) -> list[str]:
        return [parameter.name for parameter in parameters if not self._node.has_parameter(parameter.name)]

    def _values(self) -> dict[str, object]:
        return plain_values(self._node.get_parameter(setting.name) for setting in SETTINGS)

    def _declare(self, setting: Setting, override: Parameter | None) -> None:
        parameter = Parameter(setting.name, _TYPES[setting.type], _ros_value(setting.default))
        if override is not None:
            wanted = coerced(override, may_be_unset=True)
            problems = self._problems(plain_values([wanted]))
            if any(problem.setting == setting.name for problem in problems):
                self._bad_overrides[setting.name] = problems[0]
            else:
                parameter = wanted
        described = descriptor(setting)
        if parameter.value != []:
            self._node.declare_parameter(setting.name, parameter.value, described, ignore_override=True)
            return
        # An empty list must be declared by type and then set: its own type would be BYTE_ARRAY
        # (ros2/rclpy#912). Only then it may become read-only.
        self._node.declare_parameter(setting.name, parameter.type_, ignore_override=True)
        self._node.set_parameters([parameter])
        described.type = parameter.type_.value
        self._node.set_descriptor(setting.name, described)

    def _judge(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        problems = self._new_problems(parameters)
        if not problems and not self._problems(self._values()):
            problems = self._review(self.candidate(parameters))
        return refusal(problems) if problems else SetParametersResult(successful=True)

    def _committed(self, parameters: Sequence[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name in self._sources:
                self._sources[parameter.name] = Source.RUN_TIME
            self._bad_overrides.pop(parameter.name, None)
            for unknown in [name for name in self._bad_overrides if meant_setting(name) == parameter.name]:
                del self._bad_overrides[unknown]
        is_ours = any(parameter.name in SETTINGS_BY_NAME for parameter in parameters)
        if is_ours and not self.problems():  # else configure will name them
            self._commit(self.settings())


def refusal(problems: Iterable[Problem]) -> SetParametersResult:
    """The answer to a change that would cause `problems`."""
    return SetParametersResult(successful=False, reason=" ".join(map(str, problems)))


def _unknown_override(name: str, node_name: str) -> Problem:
    remedy = "Set the right one, or drop this one" if meant_setting(name) else "Drop it"
    return Problem(name, f"{unknown_setting(name).message} {remedy}: ros2 param delete {node_name} {name}")


def names_on_command_line(arguments: Sequence[str]) -> set[str]:
    """Parameters set by `-p [node:]name:=value` (or `--param`)."""
    assignments = [word for flag, word in pairwise(arguments) if flag in ("-p", "--param")]
    return {assignment.partition(":=")[0].rpartition(":")[2] for assignment in assignments}


def descriptor(setting: Setting) -> ParameterDescriptor:
    """What `ros2 param describe` shows of a setting, with the range that rclpy enforces."""
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
    """`parameter` in the type of its setting where the user's meaning is plain; otherwise as it is.

    As in `Setting.coerced`; and an empty list may be of any type.
    """
    setting = SETTINGS_BY_NAME.get(parameter.name)
    if setting is None:
        return parameter
    if setting.type is tuple and _is_empty(parameter, may_be_unset):
        return Parameter(parameter.name, _TYPES[tuple], [])
    value = list(parameter.value) if _is_list(parameter.value) else parameter.value
    meant = setting.coerced(value)
    return parameter if meant is value else Parameter(parameter.name, _TYPES[setting.type], meant)


def _is_empty(parameter: Parameter, may_be_unset: bool) -> bool:
    if parameter.type_ is Parameter.Type.NOT_SET:
        return may_be_unset  # YAML `[]`; from a service it means "delete"
    return parameter.type_.name.endswith("ARRAY") and len(parameter.value) == 0


def plain_values(parameters: Iterable[Parameter]) -> dict[str, object]:
    """Values by name, of those parameters that are settings."""
    return {
        parameter.name: tuple(parameter.value) if _is_list(parameter.value) else parameter.value
        for parameter in parameters
        if parameter.name in SETTINGS_BY_NAME
    }


def _is_list(value: object) -> bool:
    return hasattr(value, "__iter__") and not isinstance(value, (str, bytes))


def _ros_value(default: object) -> object:
    return list(default) if isinstance(default, tuple) else default
