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
    UNUSUAL = "unusual"
    """The image looks unlike what its camera usually sees."""
    NOVEL = "novel"
    """The image looks unlike those that are kept."""
    SAMPLE = "sample"
    """It is one of every n frames."""


class Why(NamedTuple):
    """What is behind a reason."""

    words: str
    strength: float = 1.0
    """In [0, 1]."""


_VALUES = {
    Reason.REQUESTED: 1000.0,
    Reason.CLASS: 20.0,
    Reason.UNCERTAIN: 10.0,
    Reason.UNUSUAL: 10.0,
    Reason.NOVEL: 3.0,
    Reason.UNSTEADY: 1.0,
    Reason.APPEARED: 1.0,
    Reason.FILTERED: 1.0,
    Reason.SAMPLE: 1.0,
}


def value_of(reasons: Mapping[Reason, Why]) -> float:
    """What a frame is worth that is kept for at least one reason: what its best reason is worth.

    Of a full folder the least valuable goes first.
    """
    return max(_VALUES[reason] * why.strength for reason, why in reasons.items())
