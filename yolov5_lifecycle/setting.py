"""One setting as users meet it: derived from a field, shown in descriptors, files and messages."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Literal, get_args, get_origin

from annotated_types import Ge, Le, MaxLen, MinLen, MultipleOf
from pydantic.fields import FieldInfo


class Change(Enum):
    """When a change of a setting takes effect while the node is active."""

    LIVE = "live: obeyed from the next frame"
    RELOAD = "reload: the model is prepared again and swapped between two frames"
    RESUBSCRIBE = "resubscribe: the image subscription is made anew"
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
    """Of a text in characters, of a list in entries."""
    max_length: int | None
    choices: tuple[str, ...]

    @property
    def allowed(self) -> str:
        """The rule as a reader wants it, for messages and documents."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if self.minimum is not None and self.maximum is not None:
            multiple = f", a multiple of {self.step:g}" if self.step else ""
            return f"{_TYPE_WORDS[self.type]} from {self.minimum:g} to {self.maximum:g}{multiple}"
        if self.type is tuple:
            return f"a list of at most {self.max_length} texts"
        if self.max_length is not None:
            least = f"{self.min_length} to" if self.min_length else "at most"
            return f"a text of {least} {self.max_length} characters"
        return _TYPE_WORDS[self.type]

    def coerced(self, value: object) -> object:
        """`value` in the type of this setting where the user's meaning is plain; otherwise as it is.

        A whole number for a number, one for a text, alone or in a list (`device: 0`, `classes: [dog, 2]`),
        and the YAML 1.1 boolean that `n` is read as where that is a choice.
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
    int: "a whole number",
    float: "a number",
    str: "a text",
}


def described(name: str, field: FieldInfo) -> Setting:
    """The row of a field, whose annotation carries its `Change` and whose description is text."""
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
