"""YAML parser with the rules of rcl_yaml_param_parser (ROS's parameter file reader) and size limits.

rcl takes minutes for a hostile file and ignores signals meanwhile. What this parser accepts, rcl reads
quickly and identically; what rcl interprets in a surprising way is rejected.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import yaml

from yolov5_lifecycle.printable import in_one_line

PARAMETERS = "ros__parameters"
"""The name below a node above its parameters."""
MAX_FILE_BYTES = 1 << 20
MAX_SCALARS = 20_000
"""Names and values together; rcl's time grows with the square of their number, 1 s for 10,000 parameters."""
MAX_DEPTH = 32
MAX_NAME_LENGTH = 500
"""Of a node name, or of a parameter name including its dotted prefix."""

Value = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]

# libyaml's parser if PyYAML has it, 20 times faster. Like rcl, only events are read: no object is built.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_BOOLEANS = {
    word: value
    for value, words in ((True, ("y", "yes", "true", "on")), (False, ("n", "no", "false", "off")))
    for word in (*words, *map(str.upper, words), *(word.capitalize() for word in words))
}
_INTEGER = re.compile(r"[+-]?(0[xX][0-9a-fA-F]+|0[0-7]*|[1-9][0-9]*)")
_INTEGERS = range(-(2**63), 2**63)
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_HEXADECIMAL = re.compile(r"[+-]?0[xX]([0-9a-fA-F]+\.?[0-9a-fA-F]*|\.[0-9a-fA-F]+)([pP][+-]?[0-9]+)?")
_INFINITE = re.compile(r"([+-]?)(\.(?:inf|Inf|INF)|(?i:inf|infinity))")
_NOT_A_NUMBER = re.compile(r"\.(nan|NaN|NAN)|[+-]?(?i:nan)(\([0-9a-zA-Z_]*\))?")
_MARKS = (yaml.StreamStartEvent, yaml.StreamEndEvent, yaml.DocumentStartEvent, yaml.DocumentEndEvent)
_STRING_TAG = "tag:yaml.org,2002:str"


class ParameterYamlError(ValueError):
    """YAML that ROS does not accept as parameters, or that exceeds a limit; names the problem and line."""


@dataclass(frozen=True)
class Entry:
    """One value and its path of names from the top of the file; the value None is an empty mapping."""

    names: tuple[str, ...]
    value: Value | None
    line: int


def parameter_entries(text: bytes | str) -> Iterator[Entry]:
    """The values in all documents of `text`, from top to bottom. Raises ParameterYamlError."""
    events = BoundedEvents(text)
    for event in events:
        if isinstance(event, yaml.MappingStartEvent):
            yield from _entries(events, ())
        elif not isinstance(event, _MARKS):
            raise events.error("expected names of nodes, and below them ros__parameters", event)


def parameter_value(text: str) -> Value:
    """The value of `text`, parsed as in `-p name:=text`; raises ParameterYamlError."""
    events = BoundedEvents(text)
    first = next((event for event in events if not isinstance(event, _MARKS)), None)
    if first is None:
        raise ParameterYamlError("expected a value, found nothing")
    value = _value(events, first)
    if (another := next((event for event in events if not isinstance(event, _MARKS)), None)) is not None:
        raise events.error("expected one value, found another", another)
    return value


class BoundedEvents:
    """Iterator over YAML events that enforces the limits."""

    def __init__(self, text: bytes | str) -> None:
        self._events = _parsed(text)
        self._scalars = 0

    def __iter__(self) -> Iterator[yaml.Event]:
        return self

    def __next__(self) -> yaml.Event:
        try:
            event = next(self._events)
        except (yaml.YAMLError, ValueError) as error:
            raise ParameterYamlError(in_one_line(str(error)).removesuffix(".")) from None
        if isinstance(event, yaml.AliasEvent):
            raise self.error(f"an alias (*{event.anchor}): ROS reads none, write the value again", event)
        if isinstance(event, yaml.ScalarEvent):
            self._scalars += 1
            if self._scalars > MAX_SCALARS:
                raise self.error(f"more than {MAX_SCALARS} names and values", event)
            if "\0" in event.value:
                raise self.error("a null character", event)
        return event

    @staticmethod
    def error(problem: str, event: yaml.Event) -> ParameterYamlError:
        return ParameterYamlError(f"line {_line(event)}: {in_one_line(problem)}")


def _line(event: yaml.Event) -> int:
    assert event.start_mark is not None
    return event.start_mark.line + 1


def _parsed(text: bytes | str) -> Iterator[yaml.Event]:
    yield from yaml.parse(text, Loader=_LOADER)


def _entries(events: BoundedEvents, names: tuple[str, ...]) -> Iterator[Entry]:
    """The entries of the mapping at the path `names`, up to its end; its start event is consumed."""
    is_complete = False  # for rcl, ros__parameters ends the mapping of a node
    for key in events:
        if isinstance(key, yaml.MappingEndEvent):
            return
        if not isinstance(key, yaml.ScalarEvent) or not key.value:
            raise events.error("expected a name", key)
        if is_complete:
            raise events.error(_after_parameters(names, key.value), key)
        is_complete = key.value == PARAMETERS and PARAMETERS not in names
        below = (*names, key.value)
        if sum(map(len, below)) + len(below) > MAX_NAME_LENGTH:
            raise events.error(f"a name of more than {MAX_NAME_LENGTH} characters", key)
        line, value = _line(key), next(events)
        if not isinstance(value, yaml.MappingStartEvent):
            yield Entry(below, _value(events, value), line)
            continue
        if len(below) == MAX_DEPTH:
            raise events.error(f"nested more than {MAX_DEPTH} deep", value)
        is_empty = True
        for entry in _entries(events, below):
            is_empty = False
            yield entry
        if is_empty:
            yield Entry(below, None, line)


def _after_parameters(node: tuple[str, ...], name: str) -> str:
    """The problem of `name` below `node`, after its ros__parameters, and what to write."""
    above = "/".join(node).rstrip("/")
    if name == PARAMETERS:
        return f"a second {PARAMETERS} of '{above}', which ROS does not read: join it with the first"
    return (
        f"'{name}' follows the {PARAMETERS} of '{above}', where ROS reads no further node: move it to the "
        f"left margin, as '{above}/{name}:'"
    )


def _value(events: BoundedEvents, first: yaml.Event) -> Value:
    """The scalar or list that starts with the event `first`."""
    if isinstance(first, yaml.ScalarEvent):
        return _scalar(events, first)
    if not isinstance(first, yaml.SequenceStartEvent):
        raise events.error("expected a value", first)
    values: list[bool | int | float | str] = []
    for event in events:
        if isinstance(event, yaml.SequenceEndEvent):
            break
        if not isinstance(event, yaml.ScalarEvent):
            quotes = ', write "NAME: VALUE" in quotes' if isinstance(event, yaml.MappingStartEvent) else ""
            raise events.error(f"a list may hold values alone, no lists or mappings{quotes}", event)
        value = _scalar(events, event)
        if values and type(value) is not type(values[0]):
            raise events.error(
                f"a list must hold values of one type, this one has {_shown(values[0])} and {_shown(value)}: "
                f"write {_alike(values[0], value)}",
                event,
            )
        values.append(value)
    return values  # type: ignore[return-value] # all of one type


def _shown(value: bool | int | float | str) -> str:
    return repr(value[:40]) if isinstance(value, str) else str(value).lower()


def _alike(first: bool | int | float | str, other: bool | int | float | str) -> str:
    """A hint how to write two values of a list so that they have the same type."""
    if {type(first), type(other)} == {int, float}:
        return f"[{float(first)}, {float(other)}]"
    return "[" + ", ".join(f'"{_shown(value).strip(chr(39))}"' for value in (first, other)) + "]"


def _scalar(events: BoundedEvents, event: yaml.ScalarEvent) -> bool | int | float | str:
    """A scalar in the type that rcl gives it: parsed like C, neither as YAML 1.1 nor as 1.2."""
    text = event.value
    if event.style in ("'", '"') or event.tag == _STRING_TAG:
        return text
    if not text:
        raise events.error("a name without a value", event)
    return plain_scalar(text)


def plain_scalar(text: str) -> bool | int | float | str:
    """Unquoted `text` in the type that rcl gives it."""
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    if _INTEGER.fullmatch(text) and len(text) <= _MAX_DIGITS and (number := _integer(text)) in _INTEGERS:
        return number
    if (real := _real(text)) is not None:
        return real
    return text


_MAX_DIGITS = 100  # no int64 needs that many, and Python rejects more than a few thousand


def _integer(text: str) -> int:
    """An integer parsed like C's strtoll: a leading 0x is hexadecimal, a leading 0 octal."""
    digits = text.lstrip("+-")
    base = 16 if digits[:2] in ("0x", "0X") else 8 if digits.startswith("0") else 10
    return int(text, base)


def _real(text: str) -> float | None:
    """A float parsed like C's strtod; None if trailing characters remain or a double cannot represent it."""
    if _NOT_A_NUMBER.fullmatch(text):
        return math.nan
    if match := _INFINITE.fullmatch(text):
        return -math.inf if match[1] == "-" else math.inf
    if _DECIMAL.fullmatch(text):
        real, digits = float(text), re.split("[eE]", text)[0]
    elif _HEXADECIMAL.fullmatch(text):
        try:
            real, digits = float.fromhex(text), re.split("[pP]", text)[0].lower().partition("x")[2]
        except OverflowError:
            return None
    else:
        return None
    if not math.isfinite(real):
        return None
    is_too_small = abs(real) < sys.float_info.min and any(digit not in "+-0." for digit in digits)
    return None if is_too_small else real
