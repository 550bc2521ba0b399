"""Overrides given at the start that a node cannot use: invalid values and unknown parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import islice

from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.parameters.values import coerced
from yolov5_lifecycle.settings.camera_overrides import CAMERAS
from yolov5_lifecycle.settings.schema import SEPARATOR, Problem
from yolov5_lifecycle.settings.settings import SCHEMA
from yolov5_lifecycle.settings.suggestion import MAX_SUGGESTIONS


@dataclass(frozen=True)
class UnusableOverrides:
    """Parameters from files and the command line without effect, until they are set again or deleted."""

    invalid: Mapping[str, Problem]
    """By name: of a setting, which then has its default, or of a camera's override, which is then not set."""
    unknown: Mapping[str, Parameter]
    """By names that are not parameters."""

    def problems(self, values: Mapping[str, object], node_name: str) -> list[Problem]:
        """One problem per override; `values` are the current ones of the node with the full name `node_name`.

        While `cameras` is invalid, overrides for cameras are no problem: the corrected value may name them.
        """
        are_cameras_known = CAMERAS not in self.invalid
        names = [name for name in self.unknown if are_cameras_known or SCHEMA.find(name) is None]
        return [
            *self.invalid.values(),
            *(
                _unknown(name, values, node_name, may_suggest=index < MAX_SUGGESTIONS)
                for index, name in enumerate(names)
            ),
        ]

    def may_be_deleted(self, name: str) -> bool:
        """Whether `name` is one of these overrides and not a declared parameter."""
        return name in self.unknown or (name in self.invalid and SEPARATOR in name)

    def usable_with(self, values: Mapping[str, object]) -> list[Parameter]:
        """Overrides for cameras that were missing, but are in `values`."""
        names = [name for name in self.unknown if name not in values and SCHEMA.is_known(name, values)]
        settings = SCHEMA.found(names)
        return [coerced(self.unknown[name], settings, may_be_unset=True) for name in names]

    def without(self, names: Collection[str]) -> UnusableOverrides | None:
        """The overrides that are not in `names`, or None if none are left."""
        invalid = {name: problem for name, problem in self.invalid.items() if name not in names}
        unknown = {name: parameter for name, parameter in self.unknown.items() if name not in names}
        return UnusableOverrides(invalid, unknown) if invalid or unknown else None

    def after_setting(self, names: Collection[str], values: Mapping[str, object]) -> UnusableOverrides | None:
        """The overrides left after `names` were set, with the new `values`, or None if none are left.

        Setting the parameter that an unknown name was a typo of also resolves that name.
        """
        corrected = [
            name for name in islice(self.unknown, MAX_SUGGESTIONS) if SCHEMA.meant(name, values) in names
        ]
        orphaned = [name for name in self.invalid if not SCHEMA.is_known(name, values)]
        return self.without({*names, *corrected, *orphaned})


def _unknown(name: str, values: Mapping[str, object], node_name: str, *, may_suggest: bool) -> Problem:
    problem = SCHEMA.unknown(name, values, may_suggest=may_suggest)
    if may_suggest and SCHEMA.meant(name, values):
        remedy = "Set that one, or remove this one"
    else:
        remedy = "Or remove it" if SCHEMA.find(name) else "Remove it"
    command = f"ros2 param delete {node_name} {problem.setting}"
    return Problem(problem.setting, f"{problem.message} {remedy}: {command}")
