"""Class thresholds in their text form, such as "person: 0.5"."""

from __future__ import annotations

import re

from yolov5_lifecycle.printable import in_one_line

_NUMBER = re.compile(r"(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?", re.ASCII)
MAX_CLASS_NAME = 200
"""Characters; no model has longer names."""
_MAX_NUMBER = 40
_MAX_SHOWN = 60


class ClassThresholdError(ValueError):
    """Entries that are not class thresholds."""


def class_threshold(entry: str) -> tuple[str, float]:
    """The name or index of a class and its threshold, from 0 to 1; raises ClassThresholdError.

    The last colon separates them: the name of a class may have some.
    """
    name, colon, text = (part.strip() for part in entry.rpartition(":"))
    is_number = len(text) <= _MAX_NUMBER and _NUMBER.fullmatch(text) is not None
    if len(name) > MAX_CLASS_NAME:
        raise ClassThresholdError(
            f"'{in_one_line(entry, _MAX_SHOWN)}' names a class with more than {MAX_CLASS_NAME} characters"
        )
    if not (name and colon and is_number and float(text) <= 1):
        shown = in_one_line(entry, _MAX_SHOWN)
        raise ClassThresholdError(
            f"'{shown}' is not a class name or index, a colon and a number from 0 to 1, as in 'person: 0.5'"
        )
    return name, float(text)


def class_thresholds(entries: tuple[str, ...]) -> dict[str, float]:
    """Thresholds by class name or index as in `entries`; raises ClassThresholdError."""
    found: dict[str, float] = {}
    for name, threshold in map(class_threshold, entries):
        if name in found:
            raise ClassThresholdError(f"'{in_one_line(name, _MAX_SHOWN)}' has more than one threshold")
        found[name] = threshold
    return found
