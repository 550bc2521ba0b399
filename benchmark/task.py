"""The task of a contender."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Task:
    """`name`, as defined by the module `side`, for a file of `weights` and an image of `image_hw`."""

    side: Literal["rivals", "work"]
    name: str
    weights: str
    image_hw: tuple[int, int]
