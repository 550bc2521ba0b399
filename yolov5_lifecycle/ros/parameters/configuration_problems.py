"""Why a node cannot be configured: every problem of its parameters at once, each with its remedy."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import islice

from yolov5_lifecycle.ros.parameters.camera_overrides import are_too_many, without_camera
from yolov5_lifecycle.ros.parameters.proposal import Configuration
from yolov5_lifecycle.ros.parameters.unusable_overrides import UnusableOverrides
from yolov5_lifecycle.settings.camera_names import MAX_CAMERAS
from yolov5_lifecycle.settings.camera_overrides import CAMERAS, camera_of
from yolov5_lifecycle.settings.schema import SEPARATOR, Change, Problem
from yolov5_lifecycle.settings.settings import SCHEMA, SETTINGS_BY_NAME
from yolov5_lifecycle.settings.suggestion import MAX_SUGGESTIONS
from yolov5_lifecycle.settings.value_text import value_text

Configure = Callable[[Mapping[str, object]], Configuration]
"""The configuration with these values."""


def configuration_problems(
    current: Configuration,
    unusable: UnusableOverrides,
    *,
    changed: Collection[str],
    configure: Configure,
    node_name: str,
) -> list[Problem]:
    """Problems of the `unusable` overrides, then those of the `current` values.

    Overrides for cameras that do not exist are judged, too, as if their cameras existed. `changed`: names of
    the parameters that were set at run time. `node_name`: the full name of the node.
    """
    values = current.values
    absent = without_camera({**values, **{name: None for name in unusable.invalid if name not in values}})
    unknown = unusable.uncorrected(values, changed)
    waiting = {name: values[name] for name in absent if name in values}
    named = [
        _of_name(name, values, unusable, may_suggest=index < MAX_SUGGESTIONS)
        for index, name in enumerate([*absent, *unknown])
    ]
    judged = [*(p for p in current.problems if p.setting not in absent), *_judged(waiting, values, configure)]
    return [
        *(_removable(problem, "Or remove it", node_name) for problem in unusable.invalid.values()),
        *(_removable(problem, remedy, node_name) for problem, remedy in named),
        *(problem for problem in judged if not _is_about(problem, unusable.invalid)),
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
    return SCHEMA.is_known(name, values) or (name in values and not are_too_many(values))


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


def _judged(
    waiting: Mapping[str, object], values: Mapping[str, object], configure: Configure
) -> list[Problem]:
    """Problems of the values of `waiting` overrides, if the first MAX_CAMERAS of their cameras existed."""
    cameras = tuple(islice(dict.fromkeys(map(camera_of, waiting)), MAX_CAMERAS))
    if not cameras:
        return []
    of_node = {name: value for name, value in values.items() if SEPARATOR not in name}
    of_cameras = {name: value for name, value in waiting.items() if camera_of(name) in cameras}
    found = {name: SCHEMA.problem(name, value) for name, value in of_cameras.items()}
    wrong = {name: problem for name, problem in found.items() if problem is not None}
    right = {name: value for name, value in of_cameras.items() if name not in wrong}
    problems = configure({**of_node, CAMERAS: cameras, **right}).problems
    together = (problem for problem in problems if camera_of(problem.setting) in cameras)
    return [*wrong.values(), *(problem for problem in together if not _is_about(problem, wrong))]


def _is_about(problem: Problem, invalid: Iterable[str]) -> bool:
    """Whether `problem` is about the fallback of an `invalid` setting: undecided until that is set."""
    camera, _, setting = problem.setting.rpartition(SEPARATOR)
    about = {setting, *re.findall(r"\w+", problem.message)}
    names = (name.rpartition(SEPARATOR) for name in invalid)
    return any(owner in ("", camera) and name in about for owner, _, name in names)
