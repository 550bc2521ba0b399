"""Names of cameras, and overrides of settings for one camera, such as `front.max_rate`.

The names become parts of topic names and prefixes of parameter names.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from types import MappingProxyType
from typing import TypeVar

from pydantic import BaseModel

from yolov5_lifecycle.settings.schema import SEPARATOR, Problem, Schema, Setting, SettingsError
from yolov5_lifecycle.settings.suggestion import MAX_UNKNOWN, nearest
from yolov5_lifecycle.settings.synonyms import ROS_PREFIXES
from yolov5_lifecycle.settings.value_text import shown_value

CAMERAS = "cameras"
"""The setting that names the cameras."""
MAX_CAMERAS = 16
MAX_NAME_LENGTH = 64
"""Max characters of a name."""

_NAME = re.compile(r"[A-Za-z](_?[A-Za-z0-9])*_?")
_TOPICS = ("image", "image_raw", "detections", "detections_3d", "points", "masks", "label_info")
"""First parts of the names of the node's own topics; `depth` is a setting, too."""
NODE_STATUS = "detection"
"""Name of the node's own status in /diagnostics, beside those of its cameras."""
_NONE: Mapping[str, object] = MappingProxyType({})

Model = TypeVar("Model", bound=BaseModel)


class OverridableSchema(Schema[Model]):
    """Schema of settings with the field `cameras`, whose values may have dotted names.

    The settings of each camera with overrides are validated as a whole, like those of a node with one camera.
    Then those of the node are validated, with the valid overrides by dotted name as pydantic's context.
    """

    def find(self, name: str) -> Setting | None:
        """The setting called `name`, or overridden by `name` for one camera, or None."""
        if name in self.by_name or (setting := self._inherited(name)) is None:
            return super().find(name)
        described = (
            f"{setting.description} For the camera {camera_of(name)}; if not set, {setting.name} applies."
        )
        return replace(setting, name=name, description=described)

    def is_known(self, name: str, values: Mapping[str, object]) -> bool:
        """Whether `name` is a setting, or an override of one for a camera in `values`."""
        return name in self.by_name or (
            camera_of(name) in _cameras(values) and self._inherited(name) is not None
        )

    def validated(self, values: Mapping[str, object]) -> Model:
        own = {name: value for name, value in values.items() if SEPARATOR not in name}
        dotted = {name: value for name, value in values.items() if SEPARATOR in name}
        given = {name: value for name, value in dotted.items() if self.is_known(name, values)}
        strays = [name for name in dotted if name not in given]
        overrides, of_cameras = self._of_cameras(own, given)
        settings, of_node = self._attempt(own, overrides)
        overriding = [name for name in strays if self._inherited(name)]
        too_many = {*map(str, _listed(values)[MAX_CAMERAS:])}  # as the problem of `cameras` tells
        of_strays = self.all_unknown([name for name in strays if camera_of(name) not in too_many], values)
        of_strays += filter(None, (self.problem(name, dotted[name]) for name in overriding[:MAX_UNKNOWN]))
        inherited = {f"{camera}{SEPARATOR}{problem}" for camera in _cameras(values) for problem in of_node}
        of_cameras = [each for each in of_cameras if each.setting in given or str(each) not in inherited]
        if settings is None or of_node or of_cameras or of_strays:
            raise SettingsError([*of_node, *of_cameras, *of_strays])
        return settings

    def problem(self, name: str, value: object) -> Problem | None:
        camera, separator, setting = name.rpartition(SEPARATOR)
        found = super().problem(setting, value)
        return found and Problem(f"{camera}{separator}{setting}", found.message)

    def meant(self, name: str, values: Mapping[str, object] = _NONE) -> str | None:
        camera, separator, setting = name.partition(SEPARATOR)
        cameras = _cameras(values)
        if not (separator and cameras):
            return None if self._overridden(name) else super().meant(name)  # its camera is missing
        near_camera = camera if camera in cameras else nearest(camera, cameras)
        near = setting if setting in self.by_name else super().meant(setting)
        if near_camera is None or near is None or self._inherited(f"{near_camera}{SEPARATOR}{near}") is None:
            return None
        return f"{near_camera}{SEPARATOR}{near}"

    def unknown(self, name: str, values: Mapping[str, object] = _NONE) -> Problem:
        problem = super().unknown(name, values)
        reason = self._reason(name, _cameras(values))
        return Problem(problem.setting, f"there is no such parameter: {reason}") if reason else problem

    def _reason(self, name: str, cameras: Sequence[str]) -> str:
        """Why there is no parameter `name` with these `cameras`; empty if they have nothing to do with it."""
        camera, separator, setting = name.partition(SEPARATOR)
        if self._overridden(name) and camera_names_rule([camera], self.by_name):
            return f"no camera can have the name {camera[:MAX_NAME_LENGTH]!r}. Use the camera's new name."
        if separator and camera in cameras and setting in self.by_name:
            return f"{setting} is a setting of the node, the same for all cameras."
        if separator and camera in self.by_name:
            return f"{camera} is {self.by_name[camera].allowed}, without names below it."
        if name in cameras:
            example = next(setting.name for setting in self.settings if setting.per_camera)
            return f"{name} is a camera; its settings have names such as {name}{SEPARATOR}{example}."
        if self._inherited(name) is None or (cameras and nearest(camera, cameras)):
            return ""
        present = f"has {', '.join(name[:MAX_NAME_LENGTH] for name in cameras)}" if cameras else "names none"
        return f"add the camera to {CAMERAS}, which {present}."

    def _inherited(self, name: str) -> Setting | None:
        """The setting of the node that the override `name` replaces; None if its camera cannot exist."""
        return None if camera_names_rule([camera_of(name)], self.by_name) else self._overridden(name)

    def _overridden(self, name: str) -> Setting | None:
        """The setting after the dot of `name`, whatever stands before it."""
        camera, _, overridden = name.partition(SEPARATOR)
        setting = self.by_name.get(overridden)
        return setting if camera and setting is not None and setting.per_camera else None

    def _of_cameras(
        self, own: Mapping[str, object], given: Mapping[str, object]
    ) -> tuple[dict[str, object], list[Problem]]:
        """Valid values of the overrides, and the problems of each camera with those it inherits.

        `own`: values of the node; `given`: of the overrides, by dotted name.
        """
        inherited = {name: value for name, value in own.items() if name in self.by_name} | {CAMERAS: ()}
        overrides, problems = dict[str, object](), list[Problem]()
        for camera in dict.fromkeys(map(camera_of, given)):
            values = overrides_of(camera, given)
            settings, found = self._attempt({**inherited, **values})
            problems += [Problem(f"{camera}{SEPARATOR}{each.setting}", each.message) for each in found]
            if settings is not None:
                overrides |= {f"{camera}{SEPARATOR}{name}": getattr(settings, name) for name in values}
        return overrides, problems


def overrides_of(camera: str, overrides: Mapping[str, object]) -> dict[str, object]:
    """Values of the `overrides` for one camera, by the names of the settings."""
    prefix = f"{camera}{SEPARATOR}"
    return {name.removeprefix(prefix): value for name, value in overrides.items() if name.startswith(prefix)}


def setting_of(name: str, camera: str) -> str:
    """The name of the override of the setting `name` for a camera; of itself for one without a name."""
    return f"{camera}{SEPARATOR}{name}" if camera else name


def camera_of(name: str) -> str:
    """The camera of the override `name`."""
    return name.partition(SEPARATOR)[0]


def _cameras(values: Mapping[str, object]) -> tuple[str, ...]:
    """Names of the first MAX_CAMERAS cameras in `values`, valid or not; more are refused anyway."""
    return tuple(name for name in _listed(values)[:MAX_CAMERAS] if isinstance(name, str))


def _listed(values: Mapping[str, object]) -> Sequence[object]:
    names = values.get(CAMERAS)
    return names if isinstance(names, (list, tuple)) else ()


def camera_names_rule(names: Sequence[str], settings: Collection[str]) -> str:
    """The first rule that `names` violate, or an empty string; `settings` are the names of the settings."""
    for name in names:
        if len(name) > MAX_NAME_LENGTH or not _NAME.fullmatch(name):
            return (
                f"must be names of at most {MAX_NAME_LENGTH} letters, digits and single underscores that "
                f"begin with a letter: rename {shown_value(name)}."
            )
        if owner := _owner(name, settings):
            return f"must not hold {name!r}, the name of {owner}: rename that camera."
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        return f"must name each camera once: leave out one {repeated[0]!r}."
    return ""


def usable_names(value: object) -> tuple[str, ...]:
    """The first MAX_CAMERAS valid names in `value`, which another node calls its cameras."""
    if not isinstance(value, (list, tuple)):
        return ()
    names = dict.fromkeys(name for name in value if isinstance(name, str))
    valid = (name for name in names if not camera_names_rule([name], ()))
    return tuple(islice(valid, MAX_CAMERAS))


def _owner(name: str, settings: Collection[str]) -> str:
    """What is already called `name`, or an empty string."""
    if name in settings:
        return "a setting"
    if name in _TOPICS:
        return "a topic"
    if name == NODE_STATUS:
        return "the status of the node in /diagnostics"
    return "a parameter of ROS" if f"{name}{SEPARATOR}".startswith(ROS_PREFIXES) else ""
