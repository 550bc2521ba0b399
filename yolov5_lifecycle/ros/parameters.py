"""The detector's parameters: owner of the current settings, and of each change from proposal to storage."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.declaration import Source, declare
from yolov5_lifecycle.ros.parameter_values import coerced, plain_values, ros_value
from yolov5_lifecycle.settings.schema import SEPARATOR, Change, Problem, SettingsError
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS_BY_NAME, Settings, validated

Rule = Callable[[Settings], list[Problem]]
Validate = Callable[[Mapping[str, object]], Settings]
"""See `validated`."""

MAX_SUGGESTIONS = 3
"""Max number of unknown names per request for which a similar name is suggested."""
MAX_REASON_LENGTH = 2000
"""Max length of the refusal of one change, in characters."""
_BY_EFFORT = (Change.RELOAD, Change.CAMERAS, Change.RESUBSCRIBE, Change.LIVE)


@dataclass(frozen=True, eq=False)
class Configuration:
    """Values of all settings, with the resulting settings or problems. Compared by identity."""

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
    parameters: tuple[Parameter, ...]
    """Parameters to set: coerced to the types of their settings, without those that need no change."""
    withdrawn: tuple[str, ...] = ()
    """Overrides with unknown names that the request deletes."""
    unknown: tuple[str, ...] = ()
    """Requested names that are not parameters."""
    problems: tuple[Problem, ...] = ()
    """Why the request must be refused; excludes problems that `base` already has."""
    is_direct: bool = False
    """Whether the request was made in-process, through the methods of the rclpy node."""

    @property
    def kind(self) -> Change | None:
        """The most expensive kind of change; None if no setting changes or the settings are invalid."""
        before, after = self.base.settings, self.after.settings
        if before is None or after is None:
            return None
        return next((kind for kind in _BY_EFFORT if before.differing(after, kind)), None)

    def is_about(self, parameters: Sequence[Parameter], current: Configuration) -> bool:
        """Whether it sets exactly these `parameters` (by identity) in the `current` configuration."""
        return (
            self.base is current
            and len(parameters) == len(self.parameters)
            and all(one is other for one, other in zip(parameters, self.parameters, strict=True))
        )


class SettingsParameters:
    """Owns the current settings; everybody else asks it, or gets the frozen settings with a call.

    A bad override (YAML file or command line) never raises: the parameter is declared with its default and
    the problem is kept until the parameter is set again, so that configure can report all problems.

    `propose` validates a service request, `store` sets the proposed values. In-process calls of the node's
    set_parameters methods follow the same path inside rclpy's callbacks: `review(settings)` adds the checks
    that need the loaded model, `commit(before, after)` makes the change take effect.

    `rules` are checked in addition to those of Settings, `start_problems` can only be solved by a restart.
    `arguments` are the command-line arguments. `validate` creates settings from values.
    """

    def __init__(
        self,
        node: Node,
        *,
        review: Rule,
        commit: Callable[[Settings, Settings], None],
        rules: Sequence[Rule] = (),
        start_problems: Sequence[Problem] = (),
        arguments: Sequence[str] = (),
        validate: Validate = validated,
    ) -> None:
        self._node = node
        self._review = review
        self._commit = commit
        self._rules = rules
        self._start_problems = start_problems
        self._validate = validate
        declaration = declare(node, SCHEMA, arguments=arguments)
        self._sources = dict(declaration.sources)
        self._invalid = dict(declaration.invalid)
        self._unknown = list(declaration.unknown)
        self._current = self._configuration(declaration.values)
        self._accepted: Proposal | None = None
        node.add_pre_set_parameters_callback(lambda parameters: [*self._proposal_of(parameters).parameters])
        node.add_on_set_parameters_callback(self._answer)
        node.add_post_set_parameters_callback(self._stored)

    def problems(self) -> list[Problem]:
        """Problems of the current values and of the overrides."""
        unknown = (self._unknown_override(name) for name in self._unknown)
        return [*self._invalid.values(), *unknown, *self._start_problems, *self._current.problems]

    def settings(self) -> Settings:
        """The current settings; raises SettingsError if the values contradict each other."""
        if self._current.settings is None:
            raise SettingsError(list(self._current.problems))
        return self._current.settings

    def value(self, name: str) -> Any:
        """Value of one setting, valid by itself even if the values contradict each other."""
        return self._current.values[name]

    def value_for(self, camera: str, name: str) -> Any:
        """Value of a setting for a camera in `cameras`; see `value`."""
        own = self._current.values.get(f"{camera}{SEPARATOR}{name}")
        return self.value(name) if own is None else own

    def propose(self, asked: Sequence[Parameter], *, suggestions: int = MAX_SUGGESTIONS) -> Proposal:
        """Validate a service request, except for the checks that need the model; changes nothing.

        Suggests a similar name for at most `suggestions` unknown names.
        """
        withdrawn = tuple(parameter.name for parameter in asked if self._is_withdrawn(parameter))
        rest = [parameter for parameter in asked if parameter.name not in withdrawn]
        unknown = tuple(p.name for p in rest if not self._node.has_parameter(p.name))
        problems = [
            SCHEMA.unknown(name, may_suggest=index < suggestions) for index, name in enumerate(unknown)
        ]
        wanted = [coerced(parameter, SETTINGS_BY_NAME) for parameter in rest]
        proposal = self._proposal([parameter for parameter in wanted if not self._stays(parameter)])
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
        self._unknown = [name for name in self._unknown if name not in proposal.withdrawn]
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
        changed, base = plain_values(parameters, SETTINGS_BY_NAME), self._current
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
        if problems := [problem for rule in self._rules for problem in rule(settings)]:
            return Configuration(values, None, tuple(problems))
        return Configuration(values, settings)

    def _is_withdrawn(self, parameter: Parameter) -> bool:
        """Whether `parameter` deletes an override with an unknown name."""
        return parameter.type_ is Parameter.Type.NOT_SET and parameter.name in self._unknown

    def _stays(self, parameter: Parameter) -> bool:
        """Whether `parameter` is read-only and already has this value.

        rclpy would reject it, and with it `ros2 param load` of a dump of the node.
        """
        name = parameter.name
        if not self._node.has_parameter(name) or not self._node.describe_parameter(name).read_only:
            return False
        present = self._node.get_parameter(name)
        return (parameter.type_, parameter.value) == (present.type_, present.value)

    def _unknown_override(self, name: str) -> Problem:
        problem = SCHEMA.unknown(name)
        remedy = "Set that one, or remove this one" if SCHEMA.meant(name) else "Remove it"
        command = f"ros2 param delete {self._node.get_fully_qualified_name()} {problem.setting}"
        return Problem(problem.setting, f"{problem.message} {remedy}: {command}")

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
        wanted = [coerced(parameter, SETTINGS_BY_NAME) for parameter in parameters]
        proposal = replace(self._proposal(wanted), is_direct=True)
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
        self._invalid = {name: problem for name, problem in self._invalid.items() if name not in names}
        self._unknown = [name for name in self._unknown if SCHEMA.meant(name) not in names]
        before, after = proposal.base.settings, proposal.after.settings
        if proposal.is_direct and before is not None and after is not None:
            self._commit(before, after)


def refusal(problems: Sequence[Problem]) -> SetParametersResult:
    """Result that rejects a change because of `problems`, truncated to MAX_REASON_LENGTH."""
    reason = " ".join(map(str, problems))
    if len(reason) > MAX_REASON_LENGTH:
        reason = f"{reason[:MAX_REASON_LENGTH]}... ({len(problems)} problems)"
    return SetParametersResult(successful=False, reason=reason)
