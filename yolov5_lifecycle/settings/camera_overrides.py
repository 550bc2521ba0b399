"""Overrides of settings for one camera, such as `front.max_rate`: names, values and their validation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TypeVar

from pydantic import BaseModel

from yolov5_lifecycle.settings.camera_names import (
    MAX_CAMERAS,
    MAX_NAME_LENGTH,
    camera_names_rule,
    usable_names,
)
from yolov5_lifecycle.settings.schema import SEPARATOR, Change, Problem, Schema, Setting, SettingsError
from yolov5_lifecycle.settings.suggestion import MAX_SUGGESTIONS, nearest

CAMERAS = "cameras"
"""The setting that names the cameras."""
_NONE: Mapping[str, object] = MappingProxyType({})

Model = TypeVar("Model", bound=BaseModel)


class OverridableSchema(Schema[Model]):
    """Schema of settings with the field `cameras`, whose values may have dotted names.

    The settings of each camera with overrides are validated as a whole, like those of a node with one camera.
    Then those of the node are validated, with the valid overrides by dotted name as pydantic's context.
    """

    def fallback(self, name: str, value: object) -> object:
        """Of invalid `cameras`, the names that are valid: their overrides can then be judged and set."""
        return usable_names(value, self.by_name) if name == CAMERAS else super().fallback(name, value)

    def find(self, name: str) -> Setting | None:
        """The setting called `name`, or overridden by `name` for one camera, or None."""
        if name in self.by_name or (setting := self._inherited(name)) is None:
            return self.by_name.get(name)
        described = (
            f"{setting.description} For the camera {camera_of(name)}; if not set, {setting.name} applies."
        )
        return replace(setting, name=name, description=described)

    def found(self, names: Iterable[str]) -> dict[str, Setting]:
        """The settings and overrides among `names`, by name."""
        found = {name: self.find(name) for name in names}
        return {name: setting for name, setting in found.items() if setting is not None}

    def is_known(self, name: str, values: Mapping[str, object]) -> bool:
        """Whether `name` is a setting, or an override of one for a camera in `values`."""
        return name in self.by_name or (
            camera_of(name) in _cameras(values) and self._inherited(name) is not None
        )

    def validated(self, values: Mapping[str, object]) -> Model:
        own = {name: value for name, value in values.items() if SEPARATOR not in name}
        given, unknown = self._by_camera(values)
        overrides, of_cameras = self._validated_overrides(given, own)
        node, of_node = self._attempt(own, overrides)
        reported = set(of_node)
        problems = [
            *of_node,
            *(
                Problem(f"{camera}{SEPARATOR}{problem.setting}", problem.message)
                for camera, found in of_cameras.items()
                for problem in found
                if problem not in reported  # the camera inherits it
            ),
            *unknown,
        ]
        if problems or node is None:
            raise SettingsError(problems)
        return node

    def without_camera(self, name: str, values: Mapping[str, object]) -> Problem:
        """The problem of the override `name`, whose camera is not in `values`."""
        return Problem(name, _addition(_cameras(values)))

    def problem(self, name: str, value: object) -> Problem | None:
        camera, separator, setting = name.rpartition(SEPARATOR)
        found = super().problem(setting, value)
        return found and Problem(f"{camera}{separator}{setting}", found.message)

    def meant(self, name: str, values: Mapping[str, object] = _NONE) -> str | None:
        camera, separator, setting = name.partition(SEPARATOR)
        cameras = _cameras(values)
        if not (separator and cameras):
            return None if self._overridden(name) else super().meant(name)  # its camera is missing
        if setting in self.by_name and not self.by_name[setting].per_camera:
            return None
        near_camera = camera if camera in cameras else nearest(camera, cameras)
        near_setting = super().meant(setting)
        if near_camera is None or not self._may_be_camera(near_camera):
            return None
        if near_setting is None or not self.by_name[near_setting].per_camera:
            return None
        return f"{near_camera}{SEPARATOR}{near_setting}"

    def unknown(
        self, name: str, values: Mapping[str, object] = _NONE, *, may_suggest: bool = True
    ) -> Problem:
        problem = super().unknown(name, values, may_suggest=may_suggest)
        reason = self._reason(name, _cameras(values), may_suggest=may_suggest)
        return Problem(problem.setting, f"there is no such parameter: {reason}") if reason else problem

    def differing(
        self, ours: Mapping[str, object], others: Mapping[str, object], change: Change
    ) -> list[str]:
        """Names of the settings and overrides whose `Change` is `change` and whose values differ."""
        return [
            name
            for name, setting in self.found({**ours, **others}).items()
            if setting.change is change and ours.get(name) != others.get(name)
        ]

    def _reason(self, name: str, cameras: Sequence[str], *, may_suggest: bool) -> str:
        """Why there is no parameter `name` with these `cameras`; empty if they have nothing to do with it."""
        camera, separator, setting = name.partition(SEPARATOR)
        if self._overridden(name) and not self._may_be_camera(camera):
            return f"no camera can have the name {camera[:MAX_NAME_LENGTH]!r}. Use the camera's new name."
        if separator and camera in cameras and setting in self.by_name:
            return f"{setting} is a setting of the node, the same for all cameras."
        if separator and camera in self.by_name:
            return f"{camera} is {self.by_name[camera].allowed}, without names below it."
        if name in cameras:
            example = next(setting.name for setting in self.settings if setting.per_camera)
            return f"{name} is a camera; its settings have names such as {name}{SEPARATOR}{example}."
        if self._inherited(name) is None or (cameras and (not may_suggest or nearest(camera, cameras))):
            return ""
        return _addition(cameras)

    def _inherited(self, name: str) -> Setting | None:
        """The setting of the node that the override `name` replaces; None if its camera cannot exist."""
        return self._overridden(name) if self._may_be_camera(camera_of(name)) else None

    def _overridden(self, name: str) -> Setting | None:
        """The setting after the dot of `name`, whatever stands before it."""
        camera, _, overridden = name.partition(SEPARATOR)
        setting = self.by_name.get(overridden)
        return setting if camera and setting is not None and setting.per_camera else None

    def _may_be_camera(self, name: str) -> bool:
        return not camera_names_rule([name], self.by_name)

    def _by_camera(self, values: Mapping[str, object]) -> tuple[dict[str, dict[str, object]], list[Problem]]:
        """Values of the overrides by camera and setting, and a problem for each unknown one."""
        cameras = _cameras(values)
        by_camera = {camera: dict[str, object]() for camera in cameras}
        unknown = []
        for name in filter(lambda name: SEPARATOR in name, values):
            camera, _, setting = name.partition(SEPARATOR)
            if camera in by_camera and self._inherited(name) is not None:
                by_camera[camera][setting] = values[name]
            else:
                unknown.append(name)
        problems = [
            self.unknown(name, {CAMERAS: cameras}, may_suggest=index < MAX_SUGGESTIONS)
            for index, name in enumerate(unknown)
        ]
        return {camera: given for camera, given in by_camera.items() if given}, problems

    def _validated_overrides(
        self, given: Mapping[str, Mapping[str, object]], own: Mapping[str, object]
    ) -> tuple[dict[str, object], dict[str, list[Problem]]]:
        """Valid values of the overrides by dotted name, and the problems of each camera.

        `given`: values by camera and setting; `own`: those of the node, which the cameras inherit.
        """
        inherited = {name: value for name, value in own.items() if name in self.by_name} | {CAMERAS: ()}
        overrides, problems = dict[str, object](), dict[str, list[Problem]]()
        for camera, values in given.items():
            settings, problems[camera] = self._attempt({**inherited, **values})
            if settings is not None:
                overrides |= {f"{camera}{SEPARATOR}{name}": getattr(settings, name) for name in values}
        return overrides, problems

    def _attempt(
        self, values: Mapping[str, object], overrides: Mapping[str, object] = _NONE
    ) -> tuple[Model | None, list[Problem]]:
        """The valid settings, or None and the problems."""
        try:
            return self._validated(values, overrides), []
        except SettingsError as error:
            return None, error.problems


def overrides_of(camera: str, overrides: Mapping[str, object]) -> dict[str, object]:
    """Values of the `overrides` for one camera, by the names of the settings."""
    prefix = f"{camera}{SEPARATOR}"
    return {name.removeprefix(prefix): value for name, value in overrides.items() if name.startswith(prefix)}


def camera_of(name: str) -> str:
    """The camera of the override `name`."""
    return name.partition(SEPARATOR)[0]


def _addition(cameras: Sequence[str]) -> str:
    """The remedy for an override whose camera is not in `cameras`."""
    present = f"has {', '.join(name[:MAX_NAME_LENGTH] for name in cameras)}" if cameras else "is empty"
    return f"add the camera to {CAMERAS}, which {present}."


def _cameras(values: Mapping[str, object]) -> tuple[str, ...]:
    """Names of the first MAX_CAMERAS cameras in `values`, valid or not; more are refused anyway."""
    names = values.get(CAMERAS)
    if not isinstance(names, (list, tuple)):
        return ()
    return tuple(name for name in names[:MAX_CAMERAS] if isinstance(name, str))
