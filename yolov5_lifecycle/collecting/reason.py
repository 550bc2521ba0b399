"""Why a frame is worth a label."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum


class Reason(Enum):
    """The value is what users read in `frames.jsonl`."""

    REQUESTED = "requested"
    """Somebody asked for it."""
    CLASS = "class"
    """It has an object of one of `collect_classes`."""
    UNSTEADY = "unsteady"
    """An object was lost and found again, or changed its class."""
    APPEARED = "appeared"
    """An object came or went without crossing the border of the image."""
    UNCERTAIN = "uncertain"
    """A score is close to its threshold."""
    FILTERED = "filtered"
    """A sure detection does not count because of regions or size limits."""
    NOVEL = "novel"
    """The image looks unlike those that are kept."""
    SAMPLE = "sample"
    """It is one of every n frames."""


_VALUES = {
    Reason.REQUESTED: 100.0,
    Reason.CLASS: 8.0,
    Reason.UNSTEADY: 4.0,
    Reason.APPEARED: 3.0,
    Reason.NOVEL: 3.0,
    Reason.UNCERTAIN: 2.0,
    Reason.FILTERED: 1.0,
    Reason.SAMPLE: 1.0,
}


def value_of(reasons: Iterable[Reason]) -> float:
    """What a frame kept for these `reasons` is worth; of a full folder the least valuable goes first."""
    return sum(_VALUES[reason] for reason in reasons)
