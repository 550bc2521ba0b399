"""Overrides given at the start that a node cannot use: invalid values and unknown parameters."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

from rclpy.parameter import Parameter

from yolov5_lifecycle.ros.parameters.camera_overrides import problem_of
from yolov5_lifecycle.ros.parameters.values import coerced, plain_values
from yolov5_lifecycle.settings.schema import SEPARATOR, Problem
from yolov5_lifecycle.settings.settings import SCHEMA
from yolov5_lifecycle.settings.suggestion import MAX_SUGGESTIONS


@dataclass(frozen=True)
class UnusableOverrides:
    """Parameters from files and the command line without effect, until they are set again or deleted."""

    invalid: Mapping[str, Problem]
    """By name: of a setting, which then has its fallback, or of a camera's override, which is not set."""
    unknown: Mapping[str, Parameter]
    """By names that are not parameters, overrides for cameras that are not in `cameras` included."""

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

    def waiting_values(self, names: Collection[str]) -> dict[str, object]:
        """Values, valid or not, of those unknown `names` that would be overrides if their cameras existed."""
        settings = SCHEMA.found(names)
        return plain_values((self._wanted(name) for name in settings), settings)

    def usable_with(self, values: Mapping[str, object], withdrawn: Collection[str]) -> list[Parameter]:
        """Valid overrides, except those `withdrawn`, for cameras that were missing, but are in `values`."""
        known = [name for name in self._known(values) if name not in values and name not in withdrawn]
        return [wanted for name in known if not problem_of(wanted := self._wanted(name))]

    def without(self, names: Collection[str]) -> UnusableOverrides | None:
        """The overrides that are not in `names`, or None if none are left."""
        invalid = {name: problem for name, problem in self.invalid.items() if name not in names}
        unknown = {name: parameter for name, parameter in self.unknown.items() if name not in names}
        return UnusableOverrides(invalid, unknown) if invalid or unknown else None

    def after_setting(self, names: Collection[str], values: Mapping[str, object]) -> UnusableOverrides | None:
        """The overrides left after `names` were set, with the new `values`, or None if none are left.

        Those whose camera was added are parameters now, with an effect or an invalid value.
        """
        known = self._known(values)
        wrong = {name: problem for name in known if (problem := problem_of(self._wanted(name))) is not None}
        orphaned = [name for name in self.invalid if not SCHEMA.is_known(name, values)]
        unknown = {name: given for name, given in self.unknown.items() if name not in known}
        return UnusableOverrides({**self.invalid, **wrong}, unknown).without({*names, *orphaned})

    def _known(self, values: Mapping[str, object]) -> list[str]:
        return [name for name in self.unknown if SCHEMA.is_known(name, values)]

    def _wanted(self, name: str) -> Parameter:
        """The override `name` as it is set once its camera exists."""
        return coerced(self.unknown[name], SCHEMA.found([name]), may_be_unset=True)
