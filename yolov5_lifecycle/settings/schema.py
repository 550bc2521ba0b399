"""Settings as declared by a pydantic model: rows for descriptors and files, validation and its messages."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType
from typing import Generic, Literal, TypeVar, get_args, get_origin

from annotated_types import Ge, Le, MaxLen, MinLen, MultipleOf
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from yolov5_lifecycle.printable import in_one_line
from yolov5_lifecycle.settings.suggestion import MAX_UNKNOWN, did_you_mean, nearest
from yolov5_lifecycle.settings.value_text import MAX_SHOWN, shown_value

Model = TypeVar("Model", bound=BaseModel)

_NONE: Mapping[str, str] = MappingProxyType({})
SEPARATOR = "."
"""Between a camera and the setting that is overridden for it, as in `front.max_rate`."""


class Change(Enum):
    """When a change to a setting takes effect while the node is active."""

    LIVE = "live: takes effect with the next frame"
    RELOAD = "reload: the new model is loaded alongside the running one and replaces it between two frames"
    CONFIGURE = "configure: set while the node is unconfigured"
    RESUBSCRIBE = "resubscribe: the subscriptions concerned are recreated"
    READ_ONLY = "read-only: set when the node starts"


class Scope(Enum):
    """What a setting applies to, if not to the whole node."""

    CAMERA = "camera: may be overridden for one camera"


class Entries(Enum):
    """How the entries of a list are written, if not as names."""

    WITH_COMMAS = "a comma does not end an entry"


@dataclass(frozen=True)
class Setting:
    """One row of the settings table, derived from a field of the model."""

    name: str
    type: type
    """bool, int, float, str, or tuple for a list of strings."""
    default: object
    description: str
    change: Change
    minimum: float | None
    maximum: float | None
    step: float | None
    min_length: int
    """Characters of a string, entries of a list."""
    max_length: int | None
    choices: tuple[str, ...]
    per_camera: bool
    """Whether it may be overridden for one camera."""
    has_commas: bool
    """Whether the entries of a list have commas."""

    @property
    def allowed(self) -> str:
        """The allowed values in words, for messages and documentation."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.minimum is not None and self.maximum is not None:
            multiple = f", a multiple of {self.step:g}" if self.step else ""
            return f"{_TYPE_WORDS[self.type]} from {self.minimum:g} to {self.maximum:g}{multiple}"
        if self.minimum is not None:
            return f"{_TYPE_WORDS[self.type]} of at least {self.minimum:g}"
        if self.type is tuple:
            return f"a list of at most {self.max_length} strings"
        if self.max_length is not None:
            shortest = f"{self.min_length} to" if self.min_length else "at most"
            return f"a string of {shortest} {self.max_length} characters"
        return "a string that is not empty" if self.min_length else _TYPE_WORDS[self.type]

    def coerced(self, value: object) -> object:
        """`value` converted to the type of this setting where that is unambiguous, otherwise unchanged.

        Converts an integer to a float, an integer to a string, alone or in a list (`device: 0`,
        `classes: [dog, 2]`), and false to "n" where that is a choice (YAML 1.1 reads `n` as false).
        """
        if self.type is float and type(value) is int:
            return float(value)
        if self.type is str and type(value) is int:
            return str(value)
        if value is False and "n" in self.choices:
            return "n"
        if self.type is tuple and isinstance(value, (list, tuple)) and int in map(type, value):
            return [str(entry) if type(entry) is int else entry for entry in value]
        return value


_TYPE_WORDS = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a string",
}


@dataclass(frozen=True)
class Problem:
    """One reason why values are not valid settings."""

    setting: str
    message: str

    def __str__(self) -> str:
        return f"{self.setting}: {self.message}"


class SettingsError(ValueError):
    """Invalid settings; `problems` lists every violated rule."""

    def __init__(self, problems: list[Problem]) -> None:
        super().__init__("\n".join(str(problem) for problem in problems))
        self.problems = problems


def violation(rule: str) -> PydanticCustomError:
    """Error for a validator of one field; `rule` follows the value, as in `must be 64 digits`."""
    return PydanticCustomError("violation", "{rule}", {"rule": rule})


def contradiction(problems: list[Problem]) -> PydanticCustomError:
    """Error for a validator of the whole model that found `problems` between settings."""
    return PydanticCustomError("contradiction", "settings contradict each other", {"problems": problems})


class Schema(Generic[Model]):
    """The settings that `model`, a frozen pydantic class, declares: each field with a `Change`.

    `synonyms`: the setting that users mean by a name of other software. `not_settings`: names that are no
    setting, with what to do instead.
    """

    def __init__(
        self,
        model: type[Model],
        *,
        synonyms: Mapping[str, str] = _NONE,
        not_settings: Mapping[str, str] = _NONE,
    ) -> None:
        self._model = model
        self._synonyms = synonyms
        self._not_settings = not_settings
        self.settings = tuple(_described(name, field) for name, field in model.model_fields.items())
        self.by_name: Mapping[str, Setting] = {setting.name: setting for setting in self.settings}

    def find(self, name: str) -> Setting | None:
        """The setting called `name`, or None."""
        return self.by_name.get(name)

    def validated(self, values: Mapping[str, object]) -> Model:
        """Settings from values by name, with defaults for the rest; SettingsError with every problem."""
        settings, problems = self._attempt(values)
        if settings is None or problems:
            raise SettingsError(problems)
        return settings

    def problem(self, name: str, value: object) -> Problem | None:
        """Why `value` of the setting `name` is invalid whatever the other values are, or None."""
        values = {name: _frozen(value)}
        try:
            self._model.model_validate(values)
        except ValidationError as error:
            details = error.errors(include_url=False, include_input=False)[0]
            return None if details["type"] == "contradiction" else self._problems(details, values)[0]
        return None

    def meant(self, name: str, values: Mapping[str, object] = _NONE) -> str | None:
        """The setting that was probably meant by `name`, or None; `values` are the present ones."""
        if name in self._not_settings:
            return None
        return self._synonyms.get(name) or nearest(name, self.by_name)

    def unknown(self, name: str, values: Mapping[str, object] = _NONE) -> Problem:
        """The problem for an unknown name, with the setting that was probably meant."""
        shown = in_one_line(name[:MAX_SHOWN])
        if name in self._not_settings:
            return Problem(shown, f"there is no such parameter: {self._not_settings[name]}")
        meant = self.meant(name, values)
        return Problem(shown, "there is no such parameter." + (f" Did you mean '{meant}'?" if meant else ""))

    def all_unknown(self, names: Sequence[str], values: Mapping[str, object] = _NONE) -> list[Problem]:
        """The problem of each of these unknown names; of very many, of the first ones and of the others."""
        told = [self.unknown(name, values) for name in names[:MAX_UNKNOWN]]
        if more := len(names) - len(told):
            told.append(Problem(f"and {more} more", "there are no such parameters."))
        return told

    def _attempt(
        self, values: Mapping[str, object], context: Mapping[str, object] | None = None
    ) -> tuple[Model | None, list[Problem]]:
        """The settings, None if one is invalid, and every problem."""
        known = {name: _frozen(value) for name, value in values.items() if name in self.by_name}
        settings, problems = None, self.all_unknown([name for name in values if name not in known], values)
        try:
            settings = self._model.model_validate(known, context=context)
        except ValidationError as error:
            found = error.errors(include_url=False, include_input=False)
            of_values = [problem for details in found for problem in self._problems(details, known)]
            problems = [*dict.fromkeys(of_values), *problems]  # one per list, however many entries are wrong
        return settings, problems

    def _problems(self, details: ErrorDetails, values: Mapping[str, object]) -> list[Problem]:
        if details["type"] == "contradiction":
            return list(details["ctx"]["problems"])
        name = str(details["loc"][0])
        setting = self.by_name[name]
        reason = _reason(setting, values[name], details)
        if setting.change is Change.READ_ONLY:
            reason += " It is read-only: restart the node with another value."
        return [Problem(name, reason)]


def _frozen(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _described(name: str, field: FieldInfo) -> Setting:
    limits = {type(rule): rule for rule in field.metadata}
    annotation = field.annotation
    choices = get_args(annotation) if get_origin(annotation) is Literal else ()
    assert field.description is not None
    return Setting(
        name=name,
        type=str if choices else (get_origin(annotation) or annotation),  # type: ignore[arg-type]
        default=field.default,
        description=field.description,
        change=next(mark for mark in field.metadata if isinstance(mark, Change)),
        minimum=limits[Ge].ge if Ge in limits else None,
        maximum=limits[Le].le if Le in limits else None,
        step=limits[MultipleOf].multiple_of if MultipleOf in limits else None,
        min_length=limits[MinLen].min_length if MinLen in limits else 0,
        max_length=limits[MaxLen].max_length if MaxLen in limits else None,
        choices=choices,
        per_camera=Scope.CAMERA in field.metadata,
        has_commas=Entries.WITH_COMMAS in field.metadata,
    )


def _reason(setting: Setting, value: object, details: ErrorDetails) -> str:
    if details["type"] == "violation":
        return f"{shown_value(value)} {details['msg']}"
    hint = _hint(setting, value) if isinstance(value, str) else ""
    return (
        f"{shown_value(value)} is not {setting.allowed}.{hint} The default is {shown_value(setting.default)}."
    )


def _hint(setting: Setting, value: str) -> str:
    """What the user who wrote `value` probably meant, with a leading space, or an empty string."""
    if setting.type is not tuple:
        return did_you_mean(value, setting.choices)
    if len(value) > MAX_SHOWN or not value.strip():
        return ""
    # A list of strings and integers is no ROS type: `ros2 param set` sends it as a string.
    inner = value.strip().removeprefix("[").removesuffix("]")
    entries = [entry.strip().strip("'\"") for entry in ([inner] if setting.has_commas else inner.split(","))]
    return f" Did you mean [{', '.join(_as_yaml_string(entry) for entry in entries)}]?"


def _as_yaml_string(entry: str) -> str:
    return entry if entry.isidentifier() else json.dumps(entry, ensure_ascii=False)
