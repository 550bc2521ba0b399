"""Why a frame is worth a label."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple


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


class Why(NamedTuple):
    """What is behind a reason."""

    words: str
    objects: int = 1
    """How many it is about."""


MAX_OBJECTS = 10
"""Objects of one reason that make an image more valuable; bounds what noise is worth."""
_VALUES = {
    Reason.REQUESTED: 1000.0,
    Reason.CLASS: 20.0,
    Reason.NOVEL: 3.0,
    Reason.UNCERTAIN: 2.0,
    Reason.UNSTEADY: 1.0,
    Reason.APPEARED: 1.0,
    Reason.FILTERED: 1.0,
    Reason.SAMPLE: 1.0,
}


def value_of(reasons: Mapping[Reason, Why]) -> float:
    """What a frame kept for these `reasons` is worth; of a full folder the least valuable goes first.

    Each object that a reason is about adds the value of the reason.
    """
    return sum(_VALUES[reason] * min(why.objects, MAX_OBJECTS) for reason, why in reasons.items())
