"""Overrides given at the start that a node cannot use: invalid values and unknown parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

from rclpy.parameter import Parameter

from yolov5_lifecycle.settings.schema import SEPARATOR, Problem
from yolov5_lifecycle.settings.settings import SCHEMA
from yolov5_lifecycle.settings.suggestion import MAX_SUGGESTIONS


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

    def without(self, names: Collection[str]) -> UnusableOverrides | None:
        """The overrides that are not in `names`, or None if none are left."""
        invalid = {name: problem for name, problem in self.invalid.items() if name not in names}
        unknown = {name: parameter for name, parameter in self.unknown.items() if name not in names}
        return UnusableOverrides(invalid, unknown) if invalid or unknown else None
