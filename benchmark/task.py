"""What a contender does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Task:
    """`name`, as the module `side` knows it, for a file of `weights` and a picture of `picture_hw`."""

    side: Literal["rivals", "work"]
    name: str
    weights: str
    picture_hw: tuple[int, int]
