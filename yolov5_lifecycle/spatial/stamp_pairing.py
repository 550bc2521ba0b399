"""Depth images paired with colour images by stamp."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Generic, TypeVar

Item = TypeVar("Item")

CAPACITY = 4
"""Newest depth images kept: at 30 Hz those of the last 0.13 s."""


class Unpaired(Enum):
    """Why a colour image has no depth image."""

    MISSING = "no depth image has been received"
    LATE = "the newest depth image is older than the colour image by more than depth_slop_s"
    PASSED = "the depth images around the colour image's stamp were lost or are no longer kept"


class DepthPairing(Generic[Item]):
    """The newest depth images, of which one is chosen for each colour image; nothing waits.

    While objects are detected in a colour image, however long that takes, the depth image nearest to it is
    kept, too. One thread adds, another one expects and pairs; what they share is replaced as a whole.
    """

    def __init__(self, slop_s: float) -> None:
        """`slop_s` is the largest difference of two stamps of a pair."""
        self._slop_ns = round(slop_s * 1e9)
        self._kept: tuple[tuple[int, Item], ...] = ()
        """Stamps in nanoseconds, rising, and what is kept for each."""
        self._expected_ns: int | None = None

    def add(self, stamp_ns: int, item: Item) -> None:
        """Keep a depth image, the CAPACITY - 1 before it, and the one nearest to the expected stamp.

        A stamp that is not newer than the last one means that time has started afresh, as when a recording
        is played again: those before are dropped.
        """
        kept = self._kept
        if kept and stamp_ns <= kept[-1][0]:
            kept = ()
        kept = (*kept, (stamp_ns, item))
        older, newest = kept[:-CAPACITY], kept[-CAPACITY:]
        if (expected_ns := self._expected_ns) is not None:
            nearest = _nearest(expected_ns, kept)
            newest = (*(depth for depth in older if depth is nearest), *newest)
        self._kept = newest

    def expect(self, stamp_ns: int) -> None:
        """Keep the depth image nearest to a colour image from now on, until the next one is expected."""
        self._expected_ns = stamp_ns

    def pair(self, stamp_ns: int) -> Item | Unpaired:
        """The depth image nearest in time to a colour image, the newer of two that are equally near.

        Otherwise the reason why none is within the slop.
        """
        kept = self._kept
        if (nearest := _nearest(stamp_ns, kept)) is None:
            return Unpaired.MISSING
        if abs(nearest[0] - stamp_ns) <= self._slop_ns:
            return nearest[1]
        return Unpaired.LATE if kept[-1][0] < stamp_ns else Unpaired.PASSED

    def clear(self) -> None:
        """Drop what is kept, as when the subscription is recreated."""
        self._kept = ()


def _nearest(stamp_ns: int, depths: Sequence[tuple[int, Item]]) -> tuple[int, Item] | None:
    """The one whose stamp is nearest, the newer of two that are equally near; None without any."""
    return min(depths, key=lambda depth: (abs(depth[0] - stamp_ns), -depth[0]), default=None)
