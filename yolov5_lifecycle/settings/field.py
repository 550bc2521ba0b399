"""A setting derived from a field of `Settings`, for parameter descriptors, files and messages."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Literal, get_args, get_origin

from annotated_types import Ge, Le, MaxLen, MinLen, MultipleOf
from pydantic.fields import FieldInfo


class Change(Enum):
    """When a change to a setting takes effect while the node is active."""

    LIVE = "live: takes effect on the next frame"
    RELOAD = "reload: the model is prepared again and swapped between two frames"
    RESUBSCRIBE = "resubscribe: the image subscription is recreated"
    READ_ONLY = "read only: decided when the process starts"


@dataclass(frozen=True)
class Setting:
    """One row of the settings table, derived from a field of `Settings`."""

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

    @property
    def allowed(self) -> str:
        """The allowed values in words, for messages and documentation."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.minimum is not None and self.maximum is not None:
            multiple = f", a multiple of {self.step:g}" if self.step else ""
            return f"{_TYPE_WORDS[self.type]} from {self.minimum:g} to {self.maximum:g}{multiple}"
        if self.type is tuple:
            return f"a list of at most {self.max_length} strings"
        if self.max_length is not None:
            least = f"{self.min_length} to" if self.min_length else "at most"
            return f"a string of {least} {self.max_length} characters"
        return _TYPE_WORDS[self.type]

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
        if self.type is tuple and isinstance(value, list) and any(type(entry) is int for entry in value):
            return [str(entry) if type(entry) is int else entry for entry in value]
        return value


_TYPE_WORDS = {
    bool: "true or false",
    int: "an integer",
    float: "a number",
    str: "a string",
}


def described(name: str, field: FieldInfo) -> Setting:
    """The `Setting` of a field whose annotation carries its `Change` and which has a description."""
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
    )
