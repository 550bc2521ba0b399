"""A validated request to change parameters, and the configuration that results from it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rclpy.parameter import Parameter

from yolov5_lifecycle.settings.field import Change
from yolov5_lifecycle.settings.settings import Problem, Settings

_BY_EFFORT = (Change.RELOAD, Change.RESUBSCRIBE, Change.LIVE)


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
