"""Why a node cannot be configured: every problem of its parameters at once, each with its remedy."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.parameters.proposal import Configuration
from yolov5_lifecycle.settings.camera_overrides import CAMERAS, camera_of
from yolov5_lifecycle.settings.schema import SEPARATOR, Change, Problem
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS_BY_NAME
from yolov5_lifecycle.settings.suggestion import MAX_SUGGESTIONS
from yolov5_lifecycle.settings.value_text import value_text


@dataclass(frozen=True)
class UnusableOverrides:
    """Parameters from files and the command line without effect, until they are set again or deleted."""

    invalid: Mapping[str, Problem]
    """By name: of a setting, which then has its fallback, or of a camera's override, which is not set."""
    unknown: Mapping[str, Parameter]
    """By names that are not parameters."""

    def deleted_by(self, asked: Sequence[Parameter]) -> tuple[str, ...]:
        """Names of those overrides, not declared as parameters, that a request deletes."""
        names = (parameter.name for parameter in asked if parameter.type_ is Parameter.Type.NOT_SET)
        return tuple(n for n in names if n in self.unknown or (n in self.invalid and SEPARATOR in n))

    def uncorrected(self, values: Mapping[str, object], changed: Collection[str]) -> list[str]:
        """The unknown names, without those whose probable meaning is among the `changed` parameters."""
        corrected = {
            name for name in islice(self.unknown, MAX_SUGGESTIONS) if SCHEMA.meant(name, values) in changed
        }
        return [name for name in self.unknown if name not in corrected]

    def without(self, names: Collection[str]) -> UnusableOverrides:
        """The overrides that are not in `names`."""
        invalid = {name: problem for name, problem in self.invalid.items() if name not in names}
        unknown = {name: parameter for name, parameter in self.unknown.items() if name not in names}
        return UnusableOverrides(invalid, unknown)


def without_camera(values: Mapping[str, object]) -> list[str]:
    """The overrides among `values` whose cameras are not in `values`."""
    return [name for name in values if SEPARATOR in name and not SCHEMA.is_known(name, values)]


def configuration_problems(
    current: Configuration,
    unusable: UnusableOverrides,
    *,
    changed: Collection[str],
    node_name: str,
) -> list[Problem]:
    """Problems of the `unusable` overrides, then those of the `current` values.

    `changed`: names of the parameters that were set at run time. `node_name`: the full name of the node.
    """
    values = current.values
    absent = without_camera({**values, **{name: None for name in unusable.invalid if name not in values}})
    unknown = unusable.uncorrected(values, changed)
    named = [
        _of_name(name, values, unusable, may_suggest=index < MAX_SUGGESTIONS)
        for index, name in enumerate([*absent, *unknown])
    ]
    return [
        *(_removable(problem, "Or remove it", node_name) for problem in unusable.invalid.values()),
        *(_removable(problem, remedy, node_name) for problem, remedy in named),
        *(
            problem
            for problem in current.problems
            if problem.setting not in absent and not _is_about(problem, unusable.invalid)
        ),
    ]


def corrections(problems: Sequence[Problem], node_name: str) -> list[str]:
    """The command that corrects values, if one of the `problems` is that of a value that may be set."""
    settings = SCHEMA.found(problem.setting for problem in problems).values()
    if all(setting.change is Change.READ_ONLY for setting in settings):
        return []
    return [f"Correct values one by one, in any order: ros2 param set {node_name} NAME VALUE"]


def accepted_until_configure(
    problems: Iterable[Problem], values: Mapping[str, object]
) -> tuple[Problem, ...]:
    """Those of the `problems` of `values` that the change of another parameter can solve."""
    return tuple(problem for problem in problems if _is_solved_by_another(problem.setting, values))


def explained(problem: Problem, values: Mapping[str, object]) -> Problem:
    """`problem` of `values` in a request, which deletes a setting by None."""
    setting = SETTINGS_BY_NAME.get(problem.setting)
    if setting is None or values.get(setting.name, setting.default) is not None:
        return problem
    default = value_text(setting.default)
    remedy = "" if setting.change is Change.READ_ONLY else f" Set it to its default: {default}."
    return Problem(setting.name, f"a parameter of the node always has a value and cannot be deleted.{remedy}")


def fixed_cameras(node_name: str) -> Problem:
    """The problem of other cameras for a node that is configured."""
    return Problem(
        CAMERAS,
        f"fixed by configure. If the node is active, ros2 lifecycle set {node_name} deactivate; then "
        f"ros2 lifecycle set {node_name} cleanup, set {CAMERAS}, configure and activate.",
    )


def _is_solved_by_another(name: str, values: Mapping[str, object]) -> bool:
    if name in values and SCHEMA.problem(name, values[name]) is not None:
        return False
    return SCHEMA.is_known(name, values) or name in values


def _of_name(
    name: str, values: Mapping[str, object], unusable: UnusableOverrides, *, may_suggest: bool
) -> tuple[Problem, str]:
    """The problem that there is no parameter `name`, and the remedy that removing it is."""
    if CAMERAS in unusable.invalid and SEPARATOR in name:
        # Whatever the camera is called, the corrected `cameras` may hold it.
        if SCHEMA.find(name):
            return Problem(name, f"add {camera_of(name)} when you correct {CAMERAS}."), "Or remove it"
        values = {**values, CAMERAS: (camera_of(name),)}
    problem = SCHEMA.unknown(name, values, may_suggest=may_suggest)
    if may_suggest and SCHEMA.meant(name, values):
        return problem, f"Set that one, {'and' if name in values else 'or'} remove this one"
    return problem, "Or remove it" if SCHEMA.find(name) else "Remove it"


def _removable(problem: Problem, remedy: str, node_name: str) -> Problem:
    """`problem` with the command that removes the parameter, unless it is one of the node."""
    if problem.setting in SETTINGS_BY_NAME:
        return problem
    command = f"ros2 param delete {node_name} {problem.setting}"
    return Problem(problem.setting, f"{problem.message} {remedy}: {command}")


def _is_about(problem: Problem, invalid: Iterable[str]) -> bool:
    """Whether `problem` is about the fallback of an `invalid` setting: undecided until that is set."""
    camera, _, setting = problem.setting.rpartition(SEPARATOR)
    about = {setting, *re.findall(r"\w+", problem.message)}
    names = (name.rpartition(SEPARATOR) for name in invalid)
    return any(owner in ("", camera) and name in about for owner, _, name in names)
