"""The detector's parameters: owner of the current settings, and of each change from proposal to storage."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import DescribeParameters
from rclpy.node import Node
from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.parameters.camera_overrides import (
    are_too_many,
    declare_missing,
    deletion,
    describe,
    log_removed,
    orphaned,
    undeclare_unset,
    without_camera,
    without_deleted,
)
from yolov5_lifecycle.ros.parameters.configuration_problems import (
    accepted_until_configure,
    configuration_problems,
    explained,
)
from yolov5_lifecycle.ros.parameters.declaration import Source, declare, source_table
from yolov5_lifecycle.ros.parameters.proposal import Configuration, Proposal, acceptance, refusal
from yolov5_lifecycle.ros.parameters.unusable_overrides import UnusableOverrides
from yolov5_lifecycle.ros.parameters.values import coerced, is_read_only, plain_values, stays
from yolov5_lifecycle.settings.schema import SEPARATOR, Change, Problem, SettingsError
from yolov5_lifecycle.settings.settings import SCHEMA, Settings, validated

Rule = Callable[[Settings], list[Problem]]
Review = Callable[[Settings | None, Settings], list[Problem]]
Validate = Callable[[Mapping[str, object]], Settings]
"""See `validated`."""

MAX_SUGGESTIONS = 3
"""Max number of unknown names per request for which a similar name is suggested."""
_BY_EFFORT = (Change.RELOAD, Change.CAMERAS, Change.RESUBSCRIBE, Change.LIVE)


def has_overrides(names: Iterable[str]) -> bool:
    """Whether some of `names` override a setting for one camera."""
    return any(SEPARATOR in name for name in names)


class SettingsParameters:
    """Owns the current settings; other code queries it or is passed the frozen settings.

    A bad override (YAML file or command line) never raises: the parameter is declared with its fallback and
    the problem is kept until the parameter is set again, so that configure can report all problems.

    While the node `is_unconfigured`, values may contradict each other and cameras with overrides may be
    missing, so that parameters can be set one by one in any order; configure then refuses what is left.

    `propose` validates a service request, `store` sets the proposed values. In-process calls of the node's
    set_parameters methods follow the same path inside rclpy's callbacks: `review(before, after)` adds the
    checks that need the loaded model, `commit(before, after)` makes the change take effect.

    `rules` are checked in addition to those of Settings, `start_problems` can only be solved by a restart.
    `arguments` are the command-line arguments. `validate` creates settings from values.
    """

    def __init__(
        self,
        node: Node,
        *,
        review: Review,
        commit: Callable[[Settings, Settings], None],
        rules: Sequence[Rule] = (),
        start_problems: Sequence[Problem] = (),
        arguments: Sequence[str] = (),
        validate: Validate = validated,
        is_unconfigured: Callable[[], bool] = lambda: False,
    ) -> None:
        self._node = node
        self._review = review
        self._commit = commit
        self._rules = rules
        self._start_problems = start_problems
        self._validate = validate
        self._is_unconfigured = is_unconfigured
        declaration = declare(node, SCHEMA, arguments=arguments)
        self._given = declaration.sources
        self._sources = {name: self._given[name] for name in declaration.values}
        self._unusable = UnusableOverrides(declaration.invalid, declaration.unknown).without(())
        self._current = self._configuration(declaration.values)
        self._accepted: Proposal | None = None
        node.add_pre_set_parameters_callback(self._declared)
        node.add_on_set_parameters_callback(self._answer)
        node.add_post_set_parameters_callback(self._stored)

    def problems(self) -> list[Problem]:
        """Problems of the current values and of the overrides."""
        of_parameters = configuration_problems(
            self._current,
            self._unusable or UnusableOverrides({}, {}),
            changed={name for name, source in self._sources.items() if source is Source.RUN_TIME},
            configure=self._configuration,
            node_name=self._node.get_fully_qualified_name(),
        )
        return [*self._start_problems, *of_parameters]

    def forget_unusable(self) -> None:
        """Forget the overrides without effect, once `problems` has none."""
        self._unusable = None

    def settings(self) -> Settings:
        """The current settings; raises SettingsError if the values contradict each other."""
        if self._current.settings is None:
            raise SettingsError(list(self._current.problems))
        return self._current.settings

    def value(self, name: str) -> Any:
        """Value of one setting, valid by itself even if the values contradict each other."""
        return self._current.values[name]

    def describe(self, request: DescribeParameters.Request, response: Any) -> Any:
        """Response of the service `describe_parameters`; also describes overrides that are not set."""
        return describe(self._node, self._current.values, request, response)

    def value_for(self, camera: str, name: str) -> Any:
        """Value of a setting for a camera in `cameras`; see `value`."""
        return self._current.values.get(f"{camera}{SEPARATOR}{name}", self.value(name))

    def propose(self, asked: Sequence[Parameter], *, suggestions: int = MAX_SUGGESTIONS) -> Proposal:
        """Validate a service request, except for the checks that need the model; changes nothing.

        Suggests a similar name for at most `suggestions` unknown names.
        """
        withdrawn = self._unusable.deleted_by(asked) if self._unusable is not None else ()
        rest = [parameter for parameter in asked if parameter.name not in withdrawn]
        settings = SCHEMA.found(parameter.name for parameter in rest)
        wanted = [coerced(parameter, settings) for parameter in rest]
        values = {**self._current.values, **plain_values(wanted, settings)}
        unknown = tuple(p.name for p in wanted if not self._is_parameter(p, values))
        problems = [
            SCHEMA.unknown(name, values, may_suggest=index < suggestions)
            for index, name in enumerate(unknown)
        ]
        known = (parameter for parameter in wanted if parameter.name not in unknown)
        proposal = self._proposal([p for p in known if not stays(self._node, p)], withdrawn)
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
                undeclare_unset(self._node, proposal.parameters)
                return result
        if self._unusable is not None:
            self._unusable = self._unusable.without(proposal.withdrawn)
        return acceptance(proposal) if proposal.unsolved else SetParametersResult(successful=True)

    def present(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """Current values of these parameters; those that are not declared are unset."""
        has, get = self._node.has_parameter, self._node.get_parameter
        return [get(p.name) if has(p.name) else deletion(p.name) for p in parameters]

    def table(self) -> str:
        """Name, value and source of every setting and override, one per line."""
        return source_table(self._current.values, self._sources)

    def _proposal(self, parameters: Sequence[Parameter], withdrawn: Collection[str] = ()) -> Proposal:
        """Proposal for parameters that are already coerced."""
        asked, base, changed = parameters, self._current, self._changed(parameters)
        values = {**base.values, **changed}
        if self._unusable is not None or has_overrides(values):
            usable = self._unusable.usable_with(values, withdrawn) if self._unusable else []
            removed = [name for name in orphaned(base.values, values) if name not in changed]
            parameters = [*parameters, *usable, *map(deletion, removed)]
            changed = self._changed(parameters)
            values = without_deleted({**base.values, **changed})
        after = self._configuration(values) if changed else base
        present = set(base.problems)
        problems = [problem for problem in after.problems if problem not in present]
        may_wait = problems and self._is_unconfigured()
        unsolved = accepted_until_configure(problems, values) if may_wait else ()
        return Proposal(
            base=base,
            after=after,
            kind=_kind(base.settings, after.settings),
            asked=tuple(asked),
            parameters=tuple(parameters),
            problems=tuple(explained(problem, values) for problem in problems if problem not in unsolved),
            unsolved=unsolved,
        )

    def _changed(self, parameters: Sequence[Parameter]) -> dict[str, object]:
        """Values of those `parameters` that are settings or overrides; None for a deleted override."""
        values = plain_values(parameters, SCHEMA.found(parameter.name for parameter in parameters))
        present = self._current.values
        return {name: value for name, value in values.items() if value is not None or name in present}

    def _configuration(self, values: Mapping[str, object]) -> Configuration:
        absent = without_camera(values) if has_overrides(values) else []
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
        return SCHEMA.is_known(name, values) or (self._is_unconfigured() and not are_too_many(values))

    # rclpy's callbacks compare their parameters with the accepted proposal. Parameters without a proposal
    # were set in-process, through the node's methods.

    def _proposal_of(self, parameters: Sequence[Parameter]) -> Proposal:
        """The accepted proposal if it covers these parameters; else create and accept a direct one."""
        accepted = self._accepted
        if accepted is None or not _is_about(accepted, parameters, self._current):
            accepted = self._direct_proposal(parameters)
            self._accepted = accepted
        return accepted

    def _declared(self, parameters: Sequence[Parameter]) -> list[Parameter]:
        """What rclpy is to set instead of `parameters`: those of their proposal, new overrides declared."""
        proposal = self._proposal_of(parameters)
        names = [parameter.name for parameter in proposal.parameters]
        is_refused = proposal.problems or (
            proposal.is_direct and any(is_read_only(self._node, name) for name in names)
        )
        if has_overrides(names) and not is_refused:
            declare_missing(self._node, proposal.parameters)
            self._accepted = proposal  # declaring ran the callbacks, which accepted another one
        return [*proposal.parameters]

    def _direct_proposal(self, parameters: Sequence[Parameter]) -> Proposal:
        by_name = SCHEMA.found(parameter.name for parameter in parameters)
        wanted = [coerced(parameter, by_name) for parameter in parameters]
        proposal = replace(self._proposal(wanted), is_direct=True)
        settings = proposal.after.settings
        if proposal.problems or settings is None or proposal.after is proposal.base:
            return proposal
        return replace(proposal, problems=tuple(self._review(proposal.base.settings, settings)))

    def _answer(self, parameters: Sequence[Parameter]) -> SetParametersResult:
        problems = self._proposal_of(parameters).problems
        return refusal(problems) if problems else SetParametersResult(successful=True)

    def _stored(self, parameters: Sequence[Parameter]) -> None:
        proposal = self._proposal_of(parameters)
        if proposal.after is proposal.base:
            return
        self._current, values = proposal.after, proposal.after.values
        names, asked = {p.name for p in parameters}, {p.name for p in proposal.asked}
        self._sources |= {
            name: Source.RUN_TIME if name in asked else self._given[name] for name in values.keys() & names
        }
        for name in self._sources.keys() - values.keys():
            del self._sources[name]
        if self._unusable is not None:
            self._unusable = self._unusable.after_setting(names, values)
        if has_overrides(proposal.base.values):
            log_removed(self._node, proposal.base.values, values)
        old, new = proposal.base.settings, proposal.after.settings
        if proposal.is_direct and old is not None and new is not None:
            self._commit(old, new)


def _kind(before: Settings | None, after: Settings | None) -> Change | None:
    if before is None or after is None:
        return None
    return next((kind for kind in _BY_EFFORT if before.differing(after, kind)), None)


def _is_about(proposal: Proposal, parameters: Sequence[Parameter], current: Configuration) -> bool:
    """Whether the proposal sets exactly these `parameters` (by identity) in the `current` configuration."""
    return (
        proposal.base is current
        and len(parameters) == len(proposal.parameters)
        and all(one is other for one, other in zip(parameters, proposal.parameters, strict=True))
    )
