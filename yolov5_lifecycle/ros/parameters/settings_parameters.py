"""The detector's parameters: owner of the current settings, and of each change from proposal to storage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import DescribeParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.parameters.configuration_problems import (
    UnusableOverrides,
    accepted_until_configure,
    configuration_problems,
    explained,
    fixed_cameras,
    without_camera,
)
from yolov5_lifecycle.ros.parameters.declaration import (
    Source,
    coerced,
    declare,
    declare_given,
    declare_missing,
    deletion,
    plain_values,
    source_table,
    stays,
    undeclare_unset,
    unset_descriptor,
)
from yolov5_lifecycle.ros.parameters.proposal import Configuration, Proposal, acceptance
from yolov5_lifecycle.settings.camera_overrides import CAMERAS
from yolov5_lifecycle.settings.schema import SEPARATOR, Change, Problem, SettingsError
from yolov5_lifecycle.settings.settings import SCHEMA, Settings, validated
from yolov5_lifecycle.settings.suggestion import MAX_SUGGESTIONS

Rule = Callable[[Settings], list[Problem]]
Validate = Callable[[Mapping[str, object]], Settings]
"""See `validated`."""

_BY_EFFORT = (Change.RELOAD, Change.RESUBSCRIBE, Change.LIVE)


class SettingsParameters:
    """Owns the current settings; other code queries it or is passed the frozen settings.

    A bad override (YAML file or command line) never raises: the parameter is declared with its fallback and
    the problem is kept until the parameter is set again, so that configure can report all problems.

    While the node `is_unconfigured`, values may contradict each other and cameras with overrides may be
    missing, so that parameters can be set one by one in any order; configure then refuses what is left.

    `propose` validates a service request, `store` sets the proposed values. Nothing else may set a parameter
    that is a setting.

    `rules` are checked in addition to those of Settings. `arguments` are the command-line arguments.
    `validate` creates settings from values.
    """

    def __init__(
        self,
        node: Node,
        *,
        rules: Sequence[Rule] = (),
        arguments: Sequence[str] = (),
        validate: Validate = validated,
        is_unconfigured: Callable[[], bool] = lambda: False,
    ) -> None:
        self._node = node
        self._rules = rules
        self._validate = validate
        self._is_unconfigured = is_unconfigured
        declaration = declare_given(node, declare(node, SCHEMA, arguments=arguments))
        self._given = declaration.sources
        self._sources = {name: self._given[name] for name in declaration.values}
        self._unusable = UnusableOverrides(declaration.invalid, declaration.unknown)
        self._current = self._configuration(declaration.values)

    def problems(self) -> list[Problem]:
        """Problems of the current values and of the overrides."""
        return configuration_problems(
            self._current,
            self._unusable,
            changed={name for name, source in self._sources.items() if source is Source.RUN_TIME},
            node_name=self._node.get_fully_qualified_name(),
        )

    def forget_unusable(self) -> None:
        """Forget the overrides without effect, once `problems` has none."""
        self._unusable = UnusableOverrides({}, {})

    def settings(self) -> Settings:
        """The current settings; raises SettingsError if the values contradict each other."""
        if self._current.settings is None:
            raise SettingsError(list(self._current.problems))
        return self._current.settings

    def value(self, name: str) -> Any:
        """Value of one setting, valid by itself even if the values contradict each other."""
        return self._current.values[name]

    def describe(self, request: DescribeParameters.Request, response: Any) -> Any:
        """Response of the service `describe_parameters`; also describes overrides that are not set.

        As with rclpy, it is empty if a name is unknown.
        """
        described = []
        for name in request.names:
            if self._node.has_parameter(name):
                described.append(self._node.describe_parameter(name))
            elif SCHEMA.is_known(name, self._current.values) and (setting := SCHEMA.find(name)):
                described.append(unset_descriptor(setting))
            else:
                return response
        response.descriptors = described
        return response

    def value_for(self, camera: str, name: str) -> Any:
        """Value of a setting for a camera in `cameras`; see `value`."""
        return self._current.values.get(f"{camera}{SEPARATOR}{name}", self.value(name))

    def propose(self, asked: Sequence[Parameter]) -> Proposal:
        """Validate a service request, except for the checks that need the model; changes nothing."""
        withdrawn = self._unusable.deleted_by(asked)
        rest = [parameter for parameter in asked if parameter.name not in withdrawn]
        settings = SCHEMA.found(parameter.name for parameter in rest)
        wanted = [coerced(parameter, settings) for parameter in rest]
        values = {**self._current.values, **plain_values(wanted, settings)}
        unknown = tuple(p.name for p in wanted if not self._is_parameter(p, values))
        of_names = [
            SCHEMA.unknown(name, values, may_suggest=index < MAX_SUGGESTIONS)
            for index, name in enumerate(unknown)
        ]
        known = [p for p in wanted if p.name not in unknown and not stays(self._node, p)]
        after = self._after(known)
        of_values, unsolved = self._problems_added_by(after)
        return Proposal(
            base=self._current,
            after=after,
            kind=_kind(self._current.settings, after.settings),
            asked=tuple(asked),
            parameters=tuple(known),
            withdrawn=withdrawn,
            unknown=unknown,
            problems=(*of_names, *of_values),
            unsolved=unsolved,
        )

    def renewed(self, proposal: Proposal) -> Proposal:
        """Return `proposal`, revalidated if another change came first."""
        return proposal if proposal.base is self._current else self.propose(proposal.asked)

    def store(self, proposal: Proposal) -> SetParametersResult:
        """Set a valid, current proposal atomically; the caller applies it to the running detection."""
        if proposal.parameters:
            declare_missing(self._node, proposal.parameters)
            result = self._node.set_parameters_atomically([*proposal.parameters])
            if not result.successful:
                undeclare_unset(self._node, proposal.parameters)
                return result
            self._keep(proposal)
        self._unusable = self._unusable.without(proposal.withdrawn)
        return acceptance(proposal) if proposal.unsolved else SetParametersResult(successful=True)

    def present(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Current values of these parameters; those that are not declared are unset."""
        has, get = self._node.has_parameter, self._node.get_parameter
        return [get(p.name) if has(p.name) else deletion(p.name) for p in parameters]

    def table(self) -> str:
        """Name, value and source of every setting and override, one per line."""
        return source_table(self._current.values, self._sources)

    def _after(self, parameters: Sequence[Parameter]) -> Configuration:
        """The configuration with `parameters`, without the overrides that are None, as that deletes them.

        It is the current one if none of `parameters` is a setting.
        """
        if not (changed := self._changed(parameters)):
            return self._current
        values = {**self._current.values, **changed}
        return self._configuration(
            {name: value for name, value in values.items() if value is not None or SEPARATOR not in name}
        )

    def _problems_added_by(self, after: Configuration) -> tuple[tuple[Problem, ...], tuple[Problem, ...]]:
        """The problems that refuse a change to `after`, and those that may wait for another change."""
        present = set(self._current.problems)
        problems = [problem for problem in after.problems if problem not in present]
        if after.values[CAMERAS] != self._current.values[CAMERAS] and not self._is_unconfigured():
            problems.append(fixed_cameras(self._node.get_fully_qualified_name()))
        may_wait = problems and self._is_unconfigured()
        unsolved = accepted_until_configure(problems, after.values) if may_wait else ()
        refused = (explained(problem, after.values) for problem in problems if problem not in unsolved)
        return tuple(refused), unsolved

    def _changed(self, parameters: Sequence[Parameter]) -> dict[str, object]:
        """Values of those `parameters` that are settings or overrides; None for a deleted override."""
        values = plain_values(parameters, SCHEMA.found(parameter.name for parameter in parameters))
        present = self._current.values
        return {name: value for name, value in values.items() if value is not None or name in present}

    def _configuration(self, values: Mapping[str, object]) -> Configuration:
        absent = without_camera(values)
        problems = [SCHEMA.without_camera(name, values) for name in absent]
        present = {name: value for name, value in values.items() if name not in absent}
        try:
            settings = self._validate(present)
        except SettingsError as error:
            return Configuration(values, None, (*error.problems, *problems))
        problems += [problem for rule in self._rules for problem in rule(settings)]
        return Configuration(values, None if problems else settings, tuple(problems))

    def _is_parameter(self, parameter: Parameter, values: Mapping[str, object]) -> bool:
        """Whether `parameter` may be set or deleted if the other values are `values`."""
        name = parameter.name
        is_unset = parameter.type_ is Parameter.Type.NOT_SET
        if SEPARATOR not in name or SCHEMA.find(name) is None or is_unset:
            return self._node.has_parameter(name) or SCHEMA.is_known(name, values)
        return SCHEMA.is_known(name, values) or self._is_unconfigured()

    def _keep(self, proposal: Proposal) -> None:
        """Make what `proposal` has set the current configuration."""
        if proposal.after is proposal.base:
            return
        self._current, values = proposal.after, proposal.after.values
        names, asked = {p.name for p in proposal.parameters}, {p.name for p in proposal.asked}
        self._sources |= {
            name: Source.RUN_TIME if name in asked else self._given[name] for name in values.keys() & names
        }
        for name in self._sources.keys() - values.keys():
            del self._sources[name]
        self._unusable = self._unusable.without(names)


def _kind(before: Settings | None, after: Settings | None) -> Change | None:
    if before is None or after is None:
        return None
    return next((kind for kind in _BY_EFFORT if before.differing(after, kind)), None)
