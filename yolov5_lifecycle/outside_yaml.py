"""YAML from outside, such as of data sets and recordings: texts, without aliases and within limits."""

from __future__ import annotations

from collections.abc import Iterator

import yaml

from yolov5_lifecycle.printable import in_one_line

MAX_DEPTH = 20
MAX_VALUES = 500_000
"""Texts, lists and mappings."""

# libyaml's parser if PyYAML has it, 20 times faster. Only events are read: no object of YAML's is built.
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def texts_of(data: bytes | str) -> object:
    """The first document in `data` as text, list or mapping; {} if there is none.

    Texts are not interpreted. Keys that are no texts are "", and of equal keys the last one counts. Raises
    ValueError for no YAML, and for more than the limits allow; it says in which line.
    """
    events = _bounded(data)
    try:
        return next((_value(events, event, 0) for event in events if _begins(event)), {})
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(in_one_line(str(error)).removesuffix(".")) from None


def _bounded(data: bytes | str) -> Iterator[yaml.Event]:
    count = 0
    for event in yaml.parse(data, Loader=_LOADER):
        count += _begins(event)
        if count > MAX_VALUES:
            raise ValueError(f"more than {MAX_VALUES:,} values")
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"line {_line(event)}: an alias (*{event.anchor}): write the value again")
        yield event


def _begins(event: yaml.Event) -> bool:
    return isinstance(event, (yaml.ScalarEvent, yaml.SequenceStartEvent, yaml.MappingStartEvent))


def _line(event: yaml.Event) -> int:
    assert event.start_mark is not None
    return event.start_mark.line + 1


def _value(events: Iterator[yaml.Event], event: yaml.Event, depth: int) -> object:
    """The text, list or mapping that begins with `event`."""
    if depth > MAX_DEPTH:
        raise ValueError(f"line {_line(event)}: nested more than {MAX_DEPTH} deep")
    if isinstance(event, yaml.ScalarEvent):
        return str(event.value)
    if isinstance(event, yaml.SequenceStartEvent):
        return [_value(events, item, depth + 1) for item in _until(events, yaml.SequenceEndEvent)]
    keys = _until(events, yaml.MappingEndEvent)
    # The event after a key begins its value.
    pairs = ((_value(events, key, depth + 1), _value(events, next(events), depth + 1)) for key in keys)
    return {key if isinstance(key, str) else "": value for key, value in pairs}


def _until(events: Iterator[yaml.Event], end: type[yaml.Event]) -> Iterator[yaml.Event]:
    for event in events:
        if isinstance(event, end):
            return
        yield event
