"""The detector's parameters: owner of the current settings, and of each change from proposal to storage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.parameters.declaration import (
    declare,
    declare_unset,
    parameter_of,
    value_of,
)
from yolov5_lifecycle.ros.rclpy_internals import lifecycle_state, parameter_overrides
from yolov5_lifecycle.ros.topics import reliability_problems
from yolov5_lifecycle.settings.camera_overrides import CAMERAS, setting_of
from yolov5_lifecycle.settings.schema import Change, Problem, SettingsError
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS_BY_NAME, Settings, validated
from yolov5_lifecycle.settings.suggestion import MAX_UNKNOWN
from yolov5_lifecycle.settings.value_text import value_text

_LOCATING = ("weights", "weights_dir", "model_size", "weights_sha256")


@dataclass(frozen=True, eq=False)
class Configuration:
    """All values, also wrong and unknown ones, with the resulting settings or problems.

    Compared by identity.
    """

    values: Mapping[str, object]
    settings: Settings | None
    """None if there are problems."""
    problems: tuple[Problem, ...] = ()


@dataclass(frozen=True, eq=False)
class Proposal:
    """Changes that one request makes to `base`, the configuration it was validated against.

    It may be stored if `base` is still the current configuration and it has no `problems`.
    """

    base: Configuration
    after: Configuration
    """`base` itself if no setting changes."""
    asked: tuple[Parameter, ...]
    """Parameters as requested."""
    problems: tuple[Problem, ...]
    """Why the request must be refused."""
    unsolved: tuple[Problem, ...]
    """Problems that the change adds and another one can solve: accepted while the node is unconfigured."""

    @property
    def needs_model(self) -> bool:
        """Whether valid settings follow that need another model."""
        before, after = self.base.settings, self.after.settings
        return before is not None and after is not None and bool(before.differing(after, Change.RELOAD))

    @property
    def names_weights(self) -> bool:
        """Whether it asks for a weights file, perhaps for the one that is loaded."""
        return any(parameter.name in _LOCATING for parameter in self.asked)


def refused(*reasons: Problem | str) -> SetParametersResult:
    """Result that rejects a change for these `reasons`."""
    return SetParametersResult(successful=False, reason=" ".join(map(str, reasons)))


class SettingsParameters:
    """Owns the current settings; other code queries it or is passed the frozen settings.

    A bad override (YAML file or command line) never raises: it is kept among the values, and its parameter
    has the default, until it is set again or deleted, so that configure can report all problems.

    While the node is unconfigured, values may contradict each other and cameras with overrides may be
    missing, so that parameters can be set one by one in any order; configure then refuses what is left.

    `propose` validates a service request, `store` sets the proposed values. Nothing else may set a parameter
    that is a setting.
    """

    def __init__(self, node: LifecycleNode) -> None:
        self._node = node
        self._set_at_run_time = set[str]()
        self._current = self._configuration(declare(node, SCHEMA))

    @property
    def problems(self) -> tuple[Problem, ...]:
        """Problems of the current values."""
        return self._current.problems

    def explained_problems(self) -> list[str]:
        """The problems, each with the command that removes the parameter unless it is one of the node."""
        delete = f"ros2 param delete {self._node.get_fully_qualified_name()}"
        return [
            str(problem)
            if problem.setting in SETTINGS_BY_NAME or problem.setting not in self._current.values
            else f"{problem} {_removal(problem)}: {delete} {problem.setting}"
            for problem in self.problems
        ]

    def correction(self) -> list[str]:
        """The command that corrects values, if one of the problems is that of a value that may be set."""
        found = (SCHEMA.find(problem.setting) for problem in self.problems)
        if all(setting is None or setting.change is Change.READ_ONLY for setting in found):
            return []
        name = self._node.get_fully_qualified_name()
        return [f"Correct values one by one, in any order: ros2 param set {name} NAME VALUE"]

    def settings(self) -> Settings:
        """The current settings; raises SettingsError if the values contradict each other."""
        if self._current.settings is None:
            raise SettingsError(list(self._current.problems))
        return self._current.settings

    def value(self, name: str) -> Any:
        """Value of one parameter, valid by itself even if the values contradict each other."""
        return value_of(self._node.get_parameter(name), None)

    def value_for(self, camera: str, name: str) -> Any:
        """Value of a setting for a camera in `cameras`; see `value`."""
        own = setting_of(name, camera)
        return self.value(own if self._node.has_parameter(own) else name)

    def propose(self, asked: Sequence[Parameter]) -> Proposal:
        """Validate a service request, except for the checks that need the model; changes nothing."""
        wanted = {parameter.name: value_of(parameter, SCHEMA.find(parameter.name)) for parameter in asked}
        values = {**self._current.values, **wanted}
        unknown = [name for name in wanted if not self._is_parameter(name, values)]
        undeletable = [name for name in wanted if wanted[name] is None and name in SETTINGS_BY_NAME]
        fixed = [name for name in wanted if wanted[name] is not None and self._is_fixed(name, wanted[name])]
        impossible = {*unknown, *undeletable, *fixed}
        after = self._after({name: wanted[name] for name in wanted if name not in impossible})
        of_values, unsolved = self._problems_of(wanted, after)
        return Proposal(
            base=self._current,
            after=after,
            asked=tuple(asked),
            problems=(
                *SCHEMA.all_unknown(unknown, values),
                *map(_undeletable, undeletable),
                *(Problem(name, "read-only: restart the node with another value.") for name in fixed),
                *of_values,
            ),
            unsolved=tuple(unsolved),
        )

    def renewed(self, proposal: Proposal) -> Proposal:
        """Return `proposal`, revalidated if another change came first."""
        return proposal if proposal.base is self._current else self.propose(proposal.asked)

    def store(self, proposal: Proposal) -> SetParametersResult:
        """Set a valid, current proposal atomically."""
        wanted = {parameter.name: _to_set(parameter) for parameter in proposal.asked}
        parameters = [parameter for parameter in wanted.values() if not self._stays(parameter)]
        added = [SCHEMA.find(p.name) for p in parameters if not self._node.has_parameter(p.name)]
        for setting in filter(None, added):
            declare_unset(self._node, setting)
        result = SetParametersResult(successful=True)
        if parameters:
            result = self._node.set_parameters_atomically(parameters)
        if not result.successful:
            for setting in filter(None, added):
                self._node.undeclare_parameter(setting.name)
            return result
        self._current = proposal.after
        self._set_at_run_time |= {parameter.name for parameter in parameters}
        if proposal.unsolved:
            remark = "change another parameter, too, or configure is refused: "
            result.reason = remark + " ".join(map(str, proposal.unsolved))
        return result

    def table(self) -> str:
        """Name, value and source of every setting and override, one per line."""
        values = self._current.values
        width = max(map(len, values))
        return "\n".join(
            f"  {name:{width}}  {value_text(value):<28}  {self._source(name)}"
            for name, value in values.items()
        )

    def _source(self, name: str) -> str:
        if name in self._set_at_run_time:
            return "set at run time"
        return "given at the start" if name in parameter_overrides(self._node) else "default"

    def _after(self, wanted: Mapping[str, object]) -> Configuration:
        """The configuration with the settings and overrides in `wanted`, of which None deletes.

        It is the current one if there are none. Setting what was meant by an unknown name corrects that name.
        """
        present = self._current.values
        changes = {name: wanted[name] for name in wanted if name in present or SCHEMA.find(name)}
        if not changes:
            return self._current
        values = {
            name: value
            for name, value in {**present, **changes}.items()
            if name not in changes or value is not None
        }
        unknown = (name for name in values if SCHEMA.find(name) is None)
        corrected = [n for n in islice(unknown, MAX_UNKNOWN) if SCHEMA.meant(n, values) in changes]
        return self._configuration({name: value for name, value in values.items() if name not in corrected})

    def _configuration(self, values: Mapping[str, object]) -> Configuration:
        try:
            settings = validated(values)
        except SettingsError as error:
            return Configuration(values, None, tuple(error.problems))
        problems = reliability_problems(self._node, settings)
        return Configuration(values, None if problems else settings, tuple(problems))

    def _problems_of(
        self, wanted: Mapping[str, object], after: Configuration
    ) -> tuple[list[Problem], list[Problem]]:
        """The problems that refuse a change to `after`, and those that may wait for another change."""
        if lifecycle_state(self._node) == "unconfigured":
            found = [SCHEMA.problem(n, v) for n, v in wanted.items() if SCHEMA.find(n) and v is not None]
            present = set(self._current.problems)
            return [*filter(None, found)], [problem for problem in after.problems if problem not in present]
        problems = list(after.problems)
        if after.values[CAMERAS] != self._current.values[CAMERAS]:
            name = f"ros2 lifecycle set {self._node.get_fully_qualified_name()}"
            problems.append(
                Problem(
                    CAMERAS,
                    f"fixed by configure. If the node is active, {name} deactivate; then {name} cleanup, set "
                    f"{CAMERAS}, configure and activate.",
                )
            )
        return problems, []

    def _is_parameter(self, name: str, values: Mapping[str, object]) -> bool:
        """Whether `name` may be set to its value in `values`, or deleted if that is None."""
        if self._node.has_parameter(name) or SCHEMA.is_known(name, values):
            return True
        if values[name] is None:
            return name in self._current.values
        return SCHEMA.find(name) is not None and lifecycle_state(self._node) == "unconfigured"

    def _is_fixed(self, name: str, value: object) -> bool:
        setting = SETTINGS_BY_NAME.get(name)
        if setting is None or setting.change is not Change.READ_ONLY:
            return False
        given = self._current.values[name]  # wrong or not: neither its default nor False for 0 replaces it
        return (type(value), value) != (type(given), given)

    def _stays(self, parameter: Parameter) -> bool:
        """Whether `parameter` deletes an override that is not set, or is read-only and has this value.

        rclpy would reject both, the latter with `ros2 param load` of a dump of the node.
        """
        name = parameter.name
        if not self._node.has_parameter(name):
            return parameter.type_ is Parameter.Type.NOT_SET
        if not self._node.describe_parameter(name).read_only:
            return False
        present = self._node.get_parameter(name)
        return (parameter.type_, parameter.value) == (present.type_, present.value)


def _to_set(parameter: Parameter) -> Parameter:
    """`parameter` in the type of its setting; as it is if it is another one."""
    setting = SCHEMA.find(parameter.name)
    return parameter if setting is None else parameter_of(setting, value_of(parameter, setting))


def _removal(problem: Problem) -> str:
    """The remedy that the parameter is removed, beside what `problem` says."""
    is_possible = SCHEMA.find(problem.setting) is not None
    if problem.message.startswith("there is no such parameter. Did you mean"):
        return f"Set that one, {'and' if is_possible else 'or'} remove this one"
    return "Or remove it" if is_possible else "Remove it"


def _undeletable(name: str) -> Problem:
    setting = SETTINGS_BY_NAME[name]
    default = value_text(setting.default)
    remedy = "" if setting.change is Change.READ_ONLY else f" Set it to its default: {default}."
    return Problem(name, f"a parameter of the node always has a value and cannot be deleted.{remedy}")
