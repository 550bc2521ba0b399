"""Declaration, validation and storage of the node's ROS parameters, derived from Settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.parameter_values import (
    TYPES,
    coerced,
    descriptor,
    names_on_command_line,
    plain_values,
    ros_value,
)
from yolov5_lifecycle.ros.proposal import Configuration, Proposal
from yolov5_lifecycle.ros.qos_overrides import parameter_overrides, qos_contradictions, qos_problems
from yolov5_lifecycle.settings.field import Setting
from yolov5_lifecycle.settings.parameter_file import FOREIGN_PREFIXES
from yolov5_lifecycle.settings.settings import (
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
Validate = Callable[[Mapping[str, object]], Settings]
"""See `validated`."""

MAX_SUGGESTIONS = 3
"""Max number of unknown names per request for which a similar name is suggested."""
MAX_REASON_LENGTH = 2000
"""Max length of the refusal of one change, in characters."""


class Source(Enum):
    """Source of a setting's value."""

    DEFAULT = "default"
    PARAMETER_FILE = "parameter file"
    COMMAND_LINE = "command line"
    RUN_TIME = "set at run time"


@dataclass(frozen=True)
class _BadOverride:
    """An invalid override, reported as a problem until the setting `corrected_by` is set."""

    problem: Problem
    corrected_by: str | None


class SettingsParameters:
    """Owns the declared parameters, the current configuration, and rclpy's parameter callbacks.

    A bad override (YAML file or command line) never raises: the parameter is declared with its default and
    the problem is kept until the parameter is set again, so that configure can report all problems.

    `propose` validates a service request, `store` sets the proposed values. In-process calls of the node's
    set_parameters methods follow the same path inside rclpy's callbacks: `review(settings)` adds the checks
    that need the loaded model, `commit(settings)` makes the change take effect. `arguments` are the
    command-line arguments, to find the source of an override. `validate` creates settings from values.
    """

    def __init__(
        self,
        node: Node,
        *,
        review: Review,
        commit: Commit,
        arguments: Sequence[str] = (),
        validate: Validate = validated,
    ) -> None:
        self._node = node
        self._review = review
        self._commit = commit
        self._validate = validate
        self._bad_overrides: dict[str, _BadOverride] = {}
        self._sources = dict.fromkeys(SETTINGS_BY_NAME, Source.DEFAULT)
        overrides = parameter_overrides(node)
        on_command_line = names_on_command_line(arguments)
        for setting in SETTINGS:
            if (override := overrides.pop(setting.name, None)) is not None:
                is_typed = setting.name in on_command_line
                self._sources[setting.name] = Source.COMMAND_LINE if is_typed else Source.PARAMETER_FILE
            self._declare(setting, override)
        for name in overrides:
            if not name.startswith(FOREIGN_PREFIXES):
                self._bad_overrides[name] = _unknown_override(name, node.get_fully_qualified_name())
        self._qos_problems = qos_problems(node)
        self._current = self._configuration(
            plain_values(node.get_parameter(setting.name) for setting in SETTINGS)
        )
        self._accepted: Proposal | None = None
        node.add_pre_set_parameters_callback(lambda parameters: [*self._proposal_of(parameters).parameters])
        node.add_on_set_parameters_callback(self._answer)
        node.add_post_set_parameters_callback(self._stored)

    def problems(self) -> list[Problem]:
        """Problems of the current values and of the overrides."""
        bad = (override.problem for override in self._bad_overrides.values())
        return [*bad, *self._qos_problems, *self._current.problems]

    def settings(self) -> Settings:
        """The current settings; raises SettingsError if the values contradict each other."""
        if self._current.settings is None:
            raise SettingsError(list(self._current.problems))
        return self._current.settings

    def propose(self, asked: Sequence[Parameter], *, suggestions: int = MAX_SUGGESTIONS) -> Proposal:
        """Validate a service request, except for the checks that need the model; changes nothing.

        Suggests a similar name for at most `suggestions` unknown names.
        """
        withdrawn = tuple(parameter.name for parameter in asked if self._is_withdrawn(parameter))
        rest = [parameter for parameter in asked if parameter.name not in withdrawn]
        unknown = tuple(p.name for p in rest if not self._node.has_parameter(p.name))
        problems = [unknown_setting(name, suggest=index < suggestions) for index, name in enumerate(unknown)]
        wanted = [parameter for parameter in map(coerced, rest) if not self._stays(parameter)]
        proposal = self._proposal(wanted)
        return replace(
            proposal,
            asked=tuple(asked),
            withdrawn=withdrawn,
            unknown=unknown,
            problems=(*problems, *proposal.problems),
        )

    def renewed(self, proposal: Proposal) -> Proposal:
        """Return `proposal`, revalidated if another change came first."""
        return proposal if proposal.base is self._current else self.propose(proposal.asked)

    def store(self, proposal: Proposal) -> SetParametersResult:
        """Set a valid, current proposal atomically; the caller applies it to the running detection."""
        if proposal.parameters:
            self._accepted = proposal
            result = self._node.set_parameters_atomically([*proposal.parameters])
            if not result.successful:
                return result
        for name in proposal.withdrawn:
            self._bad_overrides.pop(name, None)
        return SetParametersResult(successful=True)

    def present(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Current values of these declared parameters."""
        return [self._node.get_parameter(parameter.name) for parameter in parameters]

    def table(self) -> str:
        """Name, value and source of every setting, one per line."""
        width = max(map(len, SETTINGS_BY_NAME))
        values = self._current.values
        return "\n".join(
            f"  {name:{width}}  {ros_value(values[name])!r:<28}  {source.value}"
            for name, source in self._sources.items()
        )

    def _proposal(self, parameters: Sequence[Parameter]) -> Proposal:
        """Proposal for parameters that are already coerced."""
        changed, base = plain_values(parameters), self._current
        after = self._configuration({**base.values, **changed}) if changed else base
        return Proposal(
            base=base,
            after=after,
            asked=tuple(parameters),
            parameters=tuple(parameters),
            problems=tuple(problem for problem in after.problems if problem not in base.problems),
        )

    def _configuration(self, values: Mapping[str, object]) -> Configuration:
        try:
            settings = self._validate(values)
        except SettingsError as error:
            return Configuration(values, None, tuple(error.problems))
        if problems := qos_contradictions(self._node, settings):
            return Configuration(values, None, tuple(problems))
        return Configuration(values, settings)

    def _is_withdrawn(self, parameter: Parameter) -> bool:
        """Whether `parameter` deletes an override with an unknown name."""
        return (
            parameter.type_ is Parameter.Type.NOT_SET
            and parameter.name in self._bad_overrides
            and parameter.name not in SETTINGS_BY_NAME
        )

    def _stays(self, parameter: Parameter) -> bool:
        """Whether `parameter` is read-only and already has this value.

        rclpy would reject it, and with it `ros2 param load` of a dump of the node.
        """
        name = parameter.name
        if not self._node.has_parameter(name) or not self._node.describe_parameter(name).read_only:
            return False
        present = self._node.get_parameter(name)
        return (parameter.type_, parameter.value) == (present.type_, present.value)

    def _declare(self, setting: Setting, override: Parameter | None) -> None:
        parameter = Parameter(setting.name, TYPES[setting.type], ros_value(setting.default))
        if override is not None:
            wanted = coerced(override, may_be_unset=True)
            problems = self._configuration(plain_values([wanted])).problems
            if any(problem.setting == setting.name for problem in problems):
                self._bad_overrides[setting.name] = _BadOverride(problems[0], setting.name)
            else:
                parameter = wanted
        described = descriptor(setting)
        if parameter.value != []:
            self._node.declare_parameter(setting.name, parameter.value, described, ignore_override=True)
            return
        # An empty list must be declared by type and then set: rclpy would infer BYTE_ARRAY (ros2/rclpy#912).
        # It may become read-only only after that.
        self._node.declare_parameter(setting.name, parameter.type_, ignore_override=True)
        self._node.set_parameters([parameter])
        described.type = parameter.type_.value
        self._node.set_descriptor(setting.name, described)

    # rclpy's callbacks compare their parameters with the accepted proposal. Parameters without a proposal
    # were set in-process, through the node's methods.

    def _proposal_of(self, parameters: Sequence[Parameter]) -> Proposal:
        """The accepted proposal if it covers these parameters; else create and accept a direct one."""
        accepted = self._accepted
        if accepted is None or not accepted.is_about(parameters, self._current):
            accepted = self._direct_proposal(parameters)
            self._accepted = accepted
        return accepted

    def _direct_proposal(self, parameters: Sequence[Parameter]) -> Proposal:
        proposal = replace(self._proposal([coerced(parameter) for parameter in parameters]), is_direct=True)
        settings = proposal.after.settings
        if proposal.problems or settings is None or proposal.after is proposal.base:
            return proposal
        return replace(proposal, problems=tuple(self._review(settings)))

    def _answer(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        problems = self._proposal_of(parameters).problems
        return refusal(problems) if problems else SetParametersResult(successful=True)

    def _stored(self, parameters: Sequence[Parameter]) -> None:
        proposal = self._proposal_of(parameters)
        if proposal.after is proposal.base:
            return
        self._current = proposal.after
        names = {parameter.name for parameter in parameters}
        self._sources |= dict.fromkeys(names & self._sources.keys(), Source.RUN_TIME)
        self._bad_overrides = {
            name: bad
            for name, bad in self._bad_overrides.items()
            if name not in names and bad.corrected_by not in names
        }
        if proposal.is_direct and not self.problems():  # else configure reports them
            self._commit(self.settings())


def refusal(problems: Sequence[Problem]) -> SetParametersResult:
    """Result that rejects a change because of `problems`, truncated to MAX_REASON_LENGTH."""
    reason = " ".join(map(str, problems))
    if len(reason) > MAX_REASON_LENGTH:
        reason = f"{reason[:MAX_REASON_LENGTH]}... ({len(problems)} problems)"
    return SetParametersResult(successful=False, reason=reason)


def _unknown_override(name: str, node_name: str) -> _BadOverride:
    meant, problem = meant_setting(name), unknown_setting(name)
    remedy = "Set the right one, or drop this one" if meant else "Drop it"
    message = f"{problem.message} {remedy}: ros2 param delete {node_name} {problem.setting}"
    return _BadOverride(Problem(problem.setting, message), meant)
