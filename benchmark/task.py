"""What a contender does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Task:
    """`name`, as the module `side` knows it, for a file of `weights` and a picture of `picture_hw`.

    Before each round the process rests for `pause_s`, as between the images of a slow camera.
    """

    side: Literal["rivals", "work"]
    name: str
    weights: str
    picture_hw: tuple[int, int]
    pause_s: float = 0.0

    @property
    def label(self) -> str:
        """The name, and how long the process rests."""
        return f"{self.name}, {1e3 * self.pause_s:.0f} ms apart" if self.pause_s else self.name
